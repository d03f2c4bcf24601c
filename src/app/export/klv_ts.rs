//! Video with its metadata: H.264 in an MPEG transport stream, with one KLV packet for each frame (MISB ST 0601, 0903,
//! 0604).

use std::collections::BTreeMap;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use nalgebra::{Rotation3, UnitQuaternion, Vector2, Vector3};
use prost::Message as _;

use super::{ExportError, Exported, write_error};
use crate::config::Config;
use crate::io::capture::{CaptureReader, attached_config};
use crate::io::mcap_read::McapReader;
use crate::io::new_file::NewFile;
use crate::io::proto::windhover::{Datum, Health, Ownship, TargetState, TrackStatus};
use crate::io::records::topic;
use crate::io::video::{
    H264Encoder, SeenTarget, SensorView, TargetLife, TransportStream, Unit, core_id, sensor_packet,
    targets_packet, with_time,
};
use crate::pixels;
use windhover_base::geo::{CameraModel, Geodetic, Ground, GroundPoint, LocalFrame, euler_321, locate};
use windhover_base::msg::{EventBody, FramePayload};
use windhover_base::settings::CameraConfig;
use windhover_base::time::{MonoTime, NS_PER_S};

/// Its file, and the generator's name near the start of the file.
pub(super) const FILE: (&str, &str) = ("flight.ts", "windhover");

/// Ground farther away than this is not reported, metres.
const FARTHEST_M: f64 = 5_000.0;
/// The first frame is shown at this time of the stream, ticks of 90 kHz.
const FIRST_PTS: u64 = 90_000;
/// Below this speed a vehicle is reported as stationary.
const STANDS_MPS: f64 = 0.1;
/// Frames a second where no configuration gives a rate.
const FPS: f64 = 15.0;

/// What is known about the frames before the first one is encoded.
#[derive(Default)]
struct Known {
    own: BTreeMap<u32, Ownship>,
    targets: BTreeMap<u32, Vec<TargetState>>,
    /// Numbers of targets, from 1.
    ids: BTreeMap<String, u32>,
    datum: Option<LocalFrame>,
    utc_minus_host_ns: Option<i64>,
    geoid_m: Option<f64>,
    mission: String,
    core_id: Vec<u8>,
    warnings: Vec<String>,
}

impl Known {
    fn read(mut reader: McapReader, config: Option<&Config>) -> Self {
        let mut known = Self::default();
        for (target, id) in config.iter().flat_map(|config| &config.target).zip(1..) {
            known.ids.insert(target.name.clone(), id);
        }
        for message in reader.by_ref() {
            let (name, data) = (message.channel.topic.as_str(), &message.data[..]);
            match name {
                topic::OWNSHIP => known.ownship(Ownship::decode(data).ok()),
                topic::DATUM => {
                    if let Some(d) = Datum::decode(data).ok().filter(Datum::is_sound) {
                        let at = Geodetic { lat_deg: d.lat_deg, lon_deg: d.lon_deg, height_m: d.height_m };
                        known.datum = Some(LocalFrame::new(at));
                    }
                }
                topic::HEALTH => {
                    let health = Health::decode(data).unwrap_or_default();
                    known.utc_minus_host_ns = health.utc_minus_host_ns.or(known.utc_minus_host_ns);
                    known.geoid_m = health.geoid_m.filter(|m| m.is_finite()).or(known.geoid_m);
                }
                _ if name.starts_with("/target/") && name.ends_with("/state") => {
                    known.target(TargetState::decode(data).ok());
                }
                _ => {}
            }
        }
        known.warnings = reader.take_warnings();
        if known.utc_minus_host_ns.is_none() {
            known
                .warnings
                .push("the receiver never reported the date: times of the packets are the host's".into());
        }
        known
    }

    fn ownship(&mut self, own: Option<Ownship>) {
        if let Some(own) = own.filter(|own| own.is_sound() && !own.between_frames) {
            self.own.insert(own.frame, own);
        }
    }

    fn target(&mut self, state: Option<TargetState>) {
        let told = |s: &TargetState| s.known && s.is_sound() && s.status() != TrackStatus::Lost;
        if let Some(state) = state.filter(told) {
            self.targets.entry(state.frame).or_default().push(state);
        }
    }

    fn unix_us(&self, t: MonoTime) -> u64 {
        let ns = t.ns().saturating_add(self.utc_minus_host_ns.unwrap_or(0));
        u64::try_from(ns.div_euclid(1_000)).unwrap_or(0)
    }
}

/// A frame's pose: where the camera is and looks, in the local frame.
struct Pose<'a> {
    datum: &'a LocalFrame,
    lens: &'a CameraModel,
    at_ned: Vector3<f64>,
    ned_from_camera: Rotation3<f64>,
    ground: Ground,
}

impl Pose<'_> {
    /// The ground under a pixel.
    fn ground(&self, u: f64, v: f64) -> Option<GroundPoint> {
        let px = Vector2::new(u, v);
        locate(self.lens, &self.at_ned, &self.ned_from_camera, px, &self.ground, 0.0, FARTHEST_M).ok()
    }

    fn place(&self, point: &GroundPoint) -> Geodetic {
        self.datum.geodetic(&point.ned_m)
    }

    /// The pixel of a place, if it is in front of the camera.
    fn pixel(&self, ned: &Vector3<f64>) -> Option<(f64, f64)> {
        let seen = self.ned_from_camera.inverse() * (ned - self.at_ned);
        self.lens.project(&seen).map(|projection| (projection.px.x, projection.px.y))
    }
}

/// Azimuth, elevation and roll of a sensor whose axes are the optical axis, image right, image down: the angles of
/// Rz(azimuth) Ry(elevation) Rx(roll). Straight down, where azimuth and roll are not separable, all of the rotation is
/// azimuth.
fn relative_deg(body_from_camera: &Rotation3<f64>) -> [f64; 3] {
    let axes = [Vector3::z(), Vector3::x(), Vector3::y()].map(|axis| body_from_camera * axis);
    let body_from_sensor = Rotation3::from_basis_unchecked(&axes);
    let m = body_from_sensor.matrix();
    if m[(0, 0)].hypot(m[(1, 0)]) < 1e-6 {
        let elevation = if m[(2, 0)] > 0.0 { -90.0 } else { 90.0 };
        return [(-m[(0, 1)]).atan2(m[(1, 1)]).to_degrees(), elevation, 0.0];
    }
    let (azimuth, elevation, roll) = euler_321(&body_from_sensor);
    [azimuth, elevation, roll].map(f64::to_degrees)
}

/// Angles of view across and down the middle of the frame.
fn field_deg(camera: &CameraConfig) -> Option<[f64; 2]> {
    let lens = &camera.intrinsics;
    let last = Vector2::new(f64::from(camera.width) - 1.0, f64::from(camera.height) - 1.0);
    let middle = last / 2.0;
    let angle = |from: Vector2<f64>, to: Vector2<f64>, axis: usize| {
        let [a, b] = [lens.normalised(from)?, lens.normalised(to)?];
        Some((b[axis].atan() - a[axis].atan()).to_degrees())
    };
    let across = angle(Vector2::new(0.0, middle.y), Vector2::new(last.x, middle.y), 0)?;
    let down = angle(Vector2::new(middle.x, 0.0), Vector2::new(middle.x, last.y), 1)?;
    Some([across, down])
}

/// The content of a frame's packets.
fn view(
    frame: u32,
    t: MonoTime,
    size: (u32, u32),
    known: &Known,
    camera: Option<&CameraConfig>,
) -> (SensorView, Vec<SeenTarget>) {
    let mut view = SensorView {
        mission: known.mission.clone(),
        core_id: known.core_id.clone(),
        unix_us: known.unix_us(t),
        geoid_m: known.geoid_m,
        relative_deg: camera.map_or([0.0, -90.0, 0.0], |c| relative_deg(&c.mount.body_from_camera())),
        field_deg: camera.and_then(field_deg),
        ..SensorView::default()
    };
    let targets = known.targets.get(&frame).map_or(&[][..], Vec::as_slice);
    let mut pose = None;
    if let (Some(own), Some(datum)) = (known.own.get(&frame), &known.datum)
        && let Some(q) =
            UnitQuaternion::try_new(nalgebra::Quaternion::new(own.qw, own.qx, own.qy, own.qz), 1e-6)
    {
        let ned_from_body = q.to_rotation_matrix();
        let (heading, pitch, roll) = euler_321(&ned_from_body);
        view.platform_deg = Some([heading, pitch, roll].map(f64::to_degrees));
        let lever = camera.map_or(Vector3::zeros(), |camera| camera.mount.position());
        let at_ned = Vector3::new(own.north_m, own.east_m, own.down_m) + ned_from_body * lever;
        view.sensor = Some(datum.geodetic(&at_ned));
        // Level ground at the height of a visible vehicle, else at the datum's height.
        let down_m = targets.first().map_or(0.0, |target| datum.ned(place(target)).z);
        pose = camera.map(|camera| Pose {
            datum,
            lens: &camera.intrinsics,
            at_ned,
            ned_from_camera: ned_from_body * camera.mount.body_from_camera(),
            ground: Ground::Flat { down_m },
        });
    }
    if let Some(pose) = &pose {
        let (right, bottom) = (f64::from(size.0) - 1.0, f64::from(size.1) - 1.0);
        let center = pose.ground(right / 2.0, bottom / 2.0);
        (view.center, view.slant_m) = (center.map(|c| pose.place(&c)), center.map(|c| c.slant_m));
        let ends = pose.ground(0.0, bottom / 2.0).zip(pose.ground(right, bottom / 2.0));
        view.width_m = ends.map(|(left, right)| (right.ned_m - left.ned_m).norm());
        view.corners = [(0.0, 0.0), (right, 0.0), (right, bottom), (0.0, bottom)]
            .map(|(u, v)| pose.ground(u, v).map(|corner| pose.place(&corner)));
    }
    let ids = &known.ids;
    let targets = targets.iter().filter_map(|s| Some(seen(s, *ids.get(&s.target)?, pose.as_ref()))).collect();
    (view, targets)
}

fn place(s: &TargetState) -> Geodetic {
    Geodetic { lat_deg: s.lat_deg, lon_deg: s.lon_deg, height_m: s.height_m }
}

fn seen(s: &TargetState, id: u32, pose: Option<&Pose<'_>>) -> SeenTarget {
    let (sin, cos) = s.heading_rad.sin_cos();
    let pixel = pose.and_then(|pose| pose.pixel(&pose.datum.ned(place(s))));
    // Upper triangle of (north, east, heading, speed, yaw rate): nn 0, ne 1, ee 5, hh 9, hv 10, vv 12.
    let p = |k: usize| s.covariance.get(k).copied();
    let place_sigma = p(0).zip(p(1)).zip(p(5)).map(|((nn, ne), ee)| sigmas(ee, nn, ne));
    let velocity_sigma = p(9).zip(p(10)).zip(p(12)).map(|((hh, hv), vv)| {
        // (east, north) = v (sin h, cos h).
        let v = s.speed_mps;
        let of =
            |a: [f64; 2], b: [f64; 2]| a[0] * b[0] * hh + (a[0] * b[1] + a[1] * b[0]) * hv + a[1] * b[1] * vv;
        let (east, north) = ([v * cos, sin], [-v * sin, cos]);
        sigmas(of(east, east), of(north, north), of(east, north))
    });
    let velocity_mps = (s.speed_mps * sin, s.speed_mps * cos);
    let life = match s.status() {
        TrackStatus::Coasting => TargetLife::Coasting,
        _ if s.speed_mps.abs() < STANDS_MPS => TargetLife::Stopped,
        _ => TargetLife::Moving,
    };
    let (lat_deg, lon_deg, height_m) = (s.lat_deg, s.lon_deg, s.height_m);
    SeenTarget { id, life, pixel, lat_deg, lon_deg, height_m, place_sigma, velocity_mps, velocity_sigma }
}

/// One sigma of east and north, and their correlation, from two variances and a covariance.
fn sigmas(ee: f64, nn: f64, en: f64) -> (f64, f64, f64) {
    let (east, north) = (ee.max(0.0).sqrt(), nn.max(0.0).sqrt());
    let correlation = if east * north > 0.0 { (en / (east * north)).clamp(-1.0, 1.0) } else { 0.0 };
    (east, north, correlation)
}

pub(super) fn export(flight: &Path, reader: McapReader, out: &Path) -> Result<Exported, ExportError> {
    let config = attached_config(flight)?.and_then(|text| Config::parse(&text).ok());
    let mut known = Known::read(reader, config.as_ref());
    known.mission = flight.file_stem().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    // The configuration gives the camera's lens and mount.
    let camera = config.as_ref().and_then(|config| toml::to_string(&config.camera).ok()).unwrap_or_default();
    known.core_id = core_id(&camera).to_vec();
    let path = out.join(FILE.0);
    let mut film = Film { known: &known, config: config.as_ref(), stream: None, frames: 0, unusable: 0 };
    let mut file = None;
    for item in CaptureReader::open(flight)? {
        let Some(EventBody::Frame(frame)) = item.event.map(|event| event.body) else { continue };
        let bytes = film.frame(&frame)?;
        if bytes.is_empty() {
            continue;
        }
        let file = match &mut file {
            Some(file) => file,
            none => none.insert(BufWriter::new(NewFile::create(&path).map_err(|e| write_error(&path, e))?)),
        };
        file.write_all(&bytes).map_err(|e| write_error(&path, e))?;
    }
    let unusable = film.unusable;
    let mut exported = Exported { files: Vec::new(), warnings: known.warnings };
    if unusable > 0 {
        exported
            .warnings
            .push(format!("{unusable} frames cannot be decoded or have another size: they are left out"));
    }
    let file = file.ok_or_else(|| ExportError::NoFrames { path: flight.to_owned() })?;
    let whole = file.into_inner().map_err(|error| error.into_error()).and_then(NewFile::finish);
    whole.map_err(|source| write_error(&path, source))?;
    exported.files.push(path);
    Ok(exported)
}

/// The video being written.
struct Film<'a> {
    known: &'a Known,
    config: Option<&'a Config>,
    stream: Option<Stream>,
    frames: u64,
    unusable: u64,
}

struct Stream {
    encoder: H264Encoder,
    ts: TransportStream,
    began: MonoTime,
    last_pts: u64,
    size: (usize, usize),
}

impl Film<'_> {
    /// The bytes of a frame: tables where decoding can start at it, its KLV, its picture.
    fn frame(&mut self, frame: &FramePayload) -> Result<Vec<u8>, ExportError> {
        let Ok(picture) = pixels::decode(frame, true) else {
            self.unusable += 1;
            return Ok(Vec::new());
        };
        let size = (picture.gray.width, picture.gray.height);
        let stream = match &mut self.stream {
            Some(stream) => stream,
            none => {
                let fps = self.config.map_or(FPS, |config| config.camera.fps);
                none.insert(Stream {
                    encoder: H264Encoder::new(size.0, size.1, fps)?,
                    ts: TransportStream::default(),
                    began: frame.t_exposure,
                    last_pts: 0,
                    size,
                })
            }
        };
        if size != stream.size {
            self.unusable += 1;
            return Ok(Vec::new());
        }
        let since = (frame.t_exposure - stream.began).ns().max(0) as u128;
        let pts = FIRST_PTS + (since * 90_000 / NS_PER_S as u128) as u64;
        let pts = pts.max(stream.last_pts + 1);
        stream.last_pts = pts;
        let (unit, key) = stream.encoder.encode(&picture.gray, picture.rgb.as_ref())?;
        let camera = self.config.map(|config| &config.camera);
        let size_px = (size.0 as u32, size.1 as u32);
        let (view, targets) = view(frame.index, frame.t_exposure, size_px, self.known, camera);
        let mut bytes = Vec::new();
        stream.ts.before(pts, &mut bytes);
        stream.ts.unit(Unit::Klv, pts, &sensor_packet(&view), &mut bytes);
        let targets = targets_packet(view.unix_us, &targets, size_px, view.field_deg, &view.core_id);
        stream.ts.unit(Unit::Klv, pts, &targets, &mut bytes);
        let unit = with_time(&unit, view.unix_us, self.known.utc_minus_host_ns.is_some());
        stream.ts.unit(Unit::Video { key }, pts, &unit, &mut bytes);
        self.frames += 1;
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::geo::{ImageTop, body_from_camera, ned_from_body_321};

    #[test]
    fn a_camera_that_looks_down_has_its_top_at_the_azimuth() {
        for (top, azimuth) in [(ImageTop::Forward, 0.0), (ImageTop::Right, 90.0), (ImageTop::Left, -90.0)] {
            let [a, e, r] = relative_deg(&body_from_camera(top, 0.0, 0.0, 0.0));
            assert!((a - azimuth).abs() < 1e-6 && (e + 90.0).abs() < 1e-6 && r == 0.0, "{a} {e} {r}");
        }
        let tilted = body_from_camera(ImageTop::Forward, 0.0, 0.3, 0.1);
        let [a, e, r] = relative_deg(&tilted).map(f64::to_radians);
        let axis = ned_from_body_321(a, e, r) * Vector3::x();
        assert!((axis - tilted * Vector3::z()).norm() < 1e-12);
    }
}
