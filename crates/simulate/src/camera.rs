//! The camera: its exposures, its pose, and the true projections of markers and ground points.

use nalgebra::{Rotation3, Vector2, Vector3};

use super::markers::corners_in_vehicle;
use super::random::{Purpose, Stream};
use super::scenario::{vector, within};
use super::world::World;
use windhover_base::geo::ned_from_body_321;
use windhover_base::msg::{FrameEncoding, FramePayload, GrayImage};
use windhover_base::time::{MonoTime, Span};

/// Iterations to find the row in which a point is seen; each reduces the error by the point's motion during the time of
/// a row.
const ROW_ITERATIONS: usize = 3;

/// Pose of the camera.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct CameraPose {
    /// Optical centre, north, east, down, metres.
    pub position_ned_m: Vector3<f64>,
    /// Attitude.
    pub ned_from_camera: Rotation3<f64>,
}

/// A marker as it truly projects.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct MarkerTruth {
    /// Index of the target in the configuration.
    pub target: usize,
    /// Index of the marker in the target.
    pub marker: usize,
    /// Whether all of it is within the frame and nothing covers it.
    pub visible: bool,
    /// Its centre, pixels (also outside the frame).
    pub center_px: Vector2<f64>,
    /// Its corners as in [`corners_in_vehicle`], pixels.
    pub corners_px: [Vector2<f64>; 4],
}

/// One exposure.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FrameTruth {
    /// Number of the frame among those delivered, from 0.
    pub frame: u32,
    /// Middle of the exposure, host time.
    pub t_true: MonoTime,
    /// The driver's stamp.
    pub t_stamp: MonoTime,
    /// When the frame was dequeued.
    pub t_recv: MonoTime,
}

impl FrameTruth {
    /// The frame as a camera without compression delivers it.
    pub fn in_grey(&self, image: GrayImage) -> FramePayload {
        let width = image.width as u32;
        FramePayload {
            index: self.frame,
            t_exposure: self.t_stamp,
            encoding: FrameEncoding::Grey,
            width,
            height: image.height as u32,
            stride: width,
            data: image.data.into(),
        }
    }
}

/// The exposures of a flight, in order.
#[derive(Clone, Debug)]
pub(super) struct Exposures {
    stream: Stream,
    attempt: u64,
    frame: u32,
}

impl Exposures {
    pub(super) fn new(seed: u64) -> Self {
        Self { stream: Stream::of(seed, Purpose::Exposure), attempt: 0, frame: 0 }
    }

    /// Nominal exposure of the next frame, without its jitter, seconds into the flight.
    pub(super) fn due_s(&self, world: &World) -> f64 {
        (self.attempt as f64 + 0.5) / world.scenario().rig.camera.fps
    }

    /// The next exposure that is delivered; `None` at the flight's end.
    pub(super) fn next(&mut self, world: &World) -> Option<FrameTruth> {
        let scenario = world.scenario();
        let (sim, config) = (&scenario.camera, &scenario.rig.camera);
        loop {
            let nominal_s = (self.attempt as f64 + 0.5) / config.fps;
            if nominal_s > scenario.duration_s {
                return None;
            }
            self.attempt += 1;
            let jitter = Span::from_ms(self.stream.normal() * sim.period_jitter_ms);
            let stamp_noise = Span::from_ms(self.stream.normal() * sim.stamp_noise_ms);
            let transfer_ms = sim.transfer_ms + self.stream.normal() * sim.transfer_jitter_ms;
            // A stamp later than the true exposure must not make the frame arrive before its stamp.
            let late = Span::from_ms(sim.stamp_late_ms.max(0.0));
            let lost = self.stream.chance(sim.dropped) || within(&sim.outages_s, nominal_s);
            if lost {
                continue;
            }
            let t_true = world.time(nominal_s) + jitter;
            let frame = self.frame;
            self.frame += 1;
            return Some(FrameTruth {
                frame,
                t_true,
                t_stamp: t_true - Span::from_ms(config.exposure_offset_ms - sim.stamp_late_ms) + stamp_noise,
                t_recv: t_true + Span::from_ms(transfer_ms.max(1.0)) + late,
            });
        }
    }
}

impl World {
    /// True pose of the camera at host time `t`: the configured mount with the scenario's mounting error.
    pub fn camera_pose(&self, t: MonoTime) -> CameraPose {
        let own = self.ownship(t);
        let mount = &self.rig().camera.mount;
        let [yaw, pitch, roll] = self.scenario().camera.mount_error_deg.map(f64::to_radians);
        CameraPose {
            position_ned_m: own.position_ned_m + own.ned_from_body * vector(mount.position_m),
            ned_from_camera: own.ned_from_body
                * ned_from_body_321(yaw, pitch, roll)
                * self.shaken(t, mount.body_from_camera()),
        }
    }

    /// Exposure of a pixel's row in a frame whose middle row is exposed at host time `t`.
    pub(super) fn row_time(&self, t: MonoTime, v: f64) -> MonoTime {
        let rows = f64::from(self.rig().camera.height.max(2) - 1);
        t + Span::from_ms((v / rows - 0.5) * self.scenario().camera.readout_ms)
    }

    /// Pixel of a point, fixed or moving, in a frame whose middle row is exposed at host time `t`: each row sees it when
    /// it is exposed. `None` where it is not in front of the lens.
    pub(super) fn seen(&self, t: MonoTime, ned: impl Fn(MonoTime) -> Vector3<f64>) -> Option<Vector2<f64>> {
        let mut px = self.project(&self.camera_pose(t), &ned(t))?;
        if self.scenario().camera.readout_ms != 0.0 {
            for _ in 0..ROW_ITERATIONS {
                let at = self.row_time(t, px.y);
                px = self.project(&self.camera_pose(at), &ned(at))?;
            }
        }
        Some(px)
    }

    /// Where marker `marker` of vehicle `target` projects in a frame exposed at host time `t`; `None` where it is behind
    /// the camera.
    pub fn marker(&self, target: usize, marker: usize, t: MonoTime) -> Option<MarkerTruth> {
        self.marker_on(target, target, marker, t)
    }

    /// The same on any mover that carries the markers of vehicle `target`.
    pub(super) fn marker_on(
        &self,
        mover: usize,
        target: usize,
        marker: usize,
        t: MonoTime,
    ) -> Option<MarkerTruth> {
        let config = &self.rig().target[target].marker[marker];
        let project = |point: &Vector3<f64>| self.seen(t, |t| self.mover(mover, t).ned_of(point));
        let center_px = project(&vector(config.position_m))?;
        let mut corners_px = [Vector2::zeros(); 4];
        for (px, corner) in corners_px.iter_mut().zip(corners_in_vehicle(config)) {
            *px = project(&corner)?;
        }
        let visible = self.covered_share(target, marker, t) <= 0.0
            && corners_px.iter().all(|px| self.in_frame(px, 0.0));
        Some(MarkerTruth { target, marker, visible, center_px, corners_px })
    }

    /// Covered share of a marker at host time `t`: 0 for none of it, 1 for all.
    pub(super) fn covered_share(&self, target: usize, marker: usize, t: MonoTime) -> f64 {
        let t_s = self.seconds(t);
        let hidden = self.scenario().camera.hidden.iter();
        let now = hidden.filter(|h| h.target == target && h.marker == marker);
        now.filter(|h| (h.from_s..h.to_s).contains(&t_s)).map(|h| h.share).fold(0.0, f64::max)
    }

    /// Pixel of a point in NED; `None` where it is not in front of the lens.
    pub fn project(&self, pose: &CameraPose, ned: &Vector3<f64>) -> Option<Vector2<f64>> {
        let in_camera = pose.ned_from_camera.inverse() * (ned - pose.position_ned_m);
        Some(self.rig().camera.intrinsics.project(&in_camera)?.px)
    }

    /// The ground point seen at a pixel; `None` above the horizon.
    pub(super) fn ground_at(&self, pose: &CameraPose, px: Vector2<f64>) -> Option<Vector3<f64>> {
        let m = self.rig().camera.intrinsics.normalised(px)?;
        let ray = pose.ned_from_camera * Vector3::new(m.x, m.y, 1.0);
        let depth = -pose.position_ned_m.z / ray.z;
        (ray.z > 0.05 && depth > 0.0).then(|| pose.position_ned_m + ray * depth)
    }

    /// Whether a pixel lies within the frame, `margin_px` from its border.
    pub(super) fn in_frame(&self, px: &Vector2<f64>, margin_px: f64) -> bool {
        let camera = &self.rig().camera;
        let inside = |x: f64, size: u32| x >= margin_px && x <= f64::from(size) - 1.0 - margin_px;
        inside(px.x, camera.width) && inside(px.y, camera.height)
    }

    /// Whether a vehicle covers this ground point at host time `t` (with the metre around it in
    /// which its shadow and parallax move).
    pub(super) fn covered_by_vehicle(&self, ground: &Vector3<f64>, t: MonoTime) -> bool {
        (0..self.movers()).any(|index| {
            let vehicle = self.mover(index, t);
            let length = self.looks(index).0.wheelbase_m.unwrap_or(1.0);
            let middle = vehicle.reference(0.5 * length);
            (ground.xy() - middle).norm() < 0.5 * length + 1.0
        })
    }
}
