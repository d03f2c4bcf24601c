//! Which MAVLink frames are sent, and when: frames from the pipeline's outputs, without sockets and clock.

use mavlink::dialects::development::{MavMessage, MavType};

use crate::config::{MavlinkConfig, MavlinkMessage};
use windhover_base::geo::LocalFrame;
use windhover_base::msg::{
    EstimatorOutput, MarkerDetection, MarkerId, Output, SensorReading, TargetState, TrackStatus,
};
use windhover_base::settings::{CameraConfig, GroundConfig, MarkerConfig, TargetConfig};
use windhover_base::time::{MonoTime, Span, UtcTime};

use super::camera::Camera;
use super::helicopter::Helicopter;
use super::packet::{self, Sender, Signature, SigningKey};
use super::report::{Sighting, VehicleReport};
use super::vehicle::{Limits, Reportable, Vehicle};
use super::{messages, motion};

/// MAV_COMP_ID_AUTOPILOT1: ground stations draw vehicles for this component only.
const VEHICLE: u8 = 1;
/// MAV_COMP_ID_CAMERA.
pub(super) const CAMERA: u8 = 100;
/// Period of heartbeats, as the protocol requires.
const HEARTBEAT_EVERY: Span = Span::from_ns(1_000_000_000);

/// One target, with the sequence number of its system id.
#[derive(Clone, Debug)]
struct System {
    vehicle: Vehicle,
    reference_m: f64,
    size_m: f64,
    markers: Vec<MarkerId>,
    in_picture: Option<[f32; 4]>,
    sequence: u8,
    /// Another system uses its id: until this time nothing is sent of the target.
    stands_back: Option<MonoTime>,
}

/// Makes MAVLink frames from the pipeline's outputs.
#[derive(Debug)]
pub struct MavlinkEncoder {
    config: MavlinkConfig,
    systems: Vec<System>,
    limits: Limits,
    period: Span,
    key: Option<SigningKey>,
    helicopter: Helicopter,
    camera: Camera,
    elevation_msl_m: Option<f64>,
    frame: Option<LocalFrame>,
    geoid_m: Option<f64>,
    utc_from_host_ns: Option<i64>,
    started: Option<MonoTime>,
    heartbeat: Option<MonoTime>,
    positions: Option<MonoTime>,
    stamp: u64,
}

impl MavlinkEncoder {
    /// For this configuration: these targets over this ground, seen by this camera.
    pub fn new(
        config: &MavlinkConfig,
        targets: &[TargetConfig],
        ground: &GroundConfig,
        camera: &CameraConfig,
        key: Option<SigningKey>,
    ) -> Self {
        let system = |(index, t): (usize, &TargetConfig)| System {
            vehicle: Vehicle::default(),
            reference_m: t.reference_m,
            size_m: t.marker.iter().filter_map(|m| m.size_m.or(m.diameter_m)).fold(0.0, f64::max),
            markers: t.marker.iter().enumerate().map(|(k, m)| seen_as(m, index, k)).collect(),
            in_picture: None,
            sequence: 0,
            stands_back: None,
        };
        Self {
            systems: targets.iter().enumerate().map(system).collect(),
            limits: Limits {
                max_age: Span::from_s(config.max_age_s),
                max_sigma_m: config.max_sigma_m,
                coast: Span::from_s(config.coast_s),
            },
            period: Span::from_s(1.0 / config.rate_hz),
            key,
            helicopter: Helicopter::default(),
            camera: Camera::new(camera),
            elevation_msl_m: ground.elevation_msl_m,
            frame: None,
            geoid_m: None,
            utc_from_host_ns: None,
            started: None,
            heartbeat: None,
            positions: None,
            stamp: 0,
            config: config.clone(),
        }
    }

    /// Takes the outputs that it needs.
    pub fn output(&mut self, output: &Output) {
        match output {
            Output::Estimator(EstimatorOutput::Estimate(estimate) | EstimatorOutput::Coasted(estimate)) => {
                if let Some(system) = self.systems.get_mut(estimate.target) {
                    system.vehicle.take(estimate);
                }
            }
            Output::Estimator(EstimatorOutput::Ownship(own)) => {
                self.helicopter.own(own, self.frame.as_ref());
            }
            Output::Datum(_, datum) => self.frame = Some(LocalFrame::new(*datum)),
            Output::Reading(SensorReading::Autopilot(position)) => {
                self.helicopter.autopilot_position(position)
            }
            Output::Reading(SensorReading::Gnss(fix)) => {
                self.geoid_m = fix.value.geoid_m.or(self.geoid_m);
                if let Some(utc) = fix.value.utc {
                    self.utc_from_host_ns = Some(utc.unix_ns() - fix.t_valid.ns());
                }
            }
            Output::Detections { markers, .. } => self.picture(markers),
            _ => {}
        }
    }

    fn picture(&mut self, markers: &[MarkerDetection]) {
        let camera = &self.camera;
        for system in &mut self.systems {
            let seen = markers.iter().filter(|seen| system.markers.contains(&seen.marker));
            system.in_picture = camera.around(seen);
        }
    }

    /// Period for calls of [`Self::tell`]: the rate of positions, and at least that of heartbeats.
    pub fn every(&self) -> Span {
        self.period.min(HEARTBEAT_EVERY)
    }

    /// The system id of a target.
    pub fn system_id(&self, index: usize) -> u8 {
        self.config.system_id.saturating_add(u8::try_from(index).unwrap_or(u8::MAX))
    }

    /// UTC at `now`, where a receiver reported it.
    pub fn utc(&self, now: MonoTime) -> Option<UtcTime> {
        let unix_ns = self.utc_from_host_ns.map(|ahead| now.ns().saturating_add(ahead));
        unix_ns.map(UtcTime::from_unix_ns)
    }

    /// Sends nothing of a target until `until`: another system has its id.
    pub fn stand_back(&mut self, index: usize, until: MonoTime) {
        if let Some(system) = self.systems.get_mut(index) {
            system.stands_back = Some(until);
        }
    }

    /// Appends the frames that are due at `now`: heartbeats once a second, and the state of every vehicle with a state
    /// that may be sent (`vehicle.rs`); called with the period of [`Self::every`]. Signed messages wait until the
    /// receiver has reported UTC, because signatures contain the time.
    pub fn tell(&mut self, now: MonoTime, out: &mut Vec<Vec<u8>>) {
        self.started.get_or_insert(now);
        if self.key.is_some() && self.utc(now).is_none() {
            return;
        }
        // A call that comes a little early counts for this period.
        let early = Span::from_s(0.5 * self.every().s());
        let due = |last: Option<MonoTime>, period| last.is_none_or(|last| now - last + early >= period);
        let (beat, positions) = (due(self.heartbeat, HEARTBEAT_EVERY), due(self.positions, self.period));
        if beat && self.has_camera() {
            self.put_camera(&messages::heartbeat_of(MavType::MAV_TYPE_CAMERA), now, out);
        }
        for index in 0..self.systems.len() {
            if self.systems[index].stands_back.is_some_and(|until| now < until) {
                continue;
            }
            let reportable = self.systems[index].vehicle.reportable(now, &self.limits);
            if beat {
                self.put(index, &messages::heartbeat(status(&reportable)), now, out);
            }
            if let Some(report) = self.report(index, &reportable, now).filter(|_| positions) {
                self.put_state(index, &report, now, out);
            }
        }
        self.heartbeat = if beat { Some(now) } else { self.heartbeat };
        self.positions = if positions { Some(now) } else { self.positions };
    }

    /// `t` since the autopilot's start, or the program's.
    fn since_start(&self, t: MonoTime) -> Span {
        let since = t - self.started.unwrap_or(t);
        self.helicopter.on_its_clock(t).unwrap_or(since)
    }

    /// The content of a vehicle's messages at `now`; `None` where nothing may be sent.
    fn report(&self, index: usize, reportable: &Reportable, now: MonoTime) -> Option<VehicleReport> {
        let (Reportable::Seen(t, state) | Reportable::Predicted(t, state)) = reportable else { return None };
        let (system, frame) = (&self.systems[index], self.frame.as_ref()?);
        let rate_mps2 = system.vehicle.rate_mps2();
        let at_now = motion::ahead(state, rate_mps2, system.reference_m, now - *t);
        let difference = self.helicopter.difference(now);
        let apart = difference.map_or(nalgebra::Vector3::zeros(), |(apart, _)| apart);
        let down = frame.datum().height_m - state.height_m;
        let place = nalgebra::Vector3::new(at_now.north_m + apart.x, at_now.east_m + apart.y, down);
        let place = frame.geodetic(&place);
        let absolute = at_now.covariance.map_or(0.0, |p| p[(0, 0)].max(p[(1, 1)]).max(0.0).sqrt());
        let is_fresh = difference.is_some_and(|(_, fresh)| fresh);
        let relative = state.relative_sigma_m.filter(|_| is_fresh);
        let report = VehicleReport {
            now: self.since_start(now),
            state: at_now,
            place_deg: (place.lat_deg, place.lon_deg),
            alt_msl_m: match difference {
                Some((apart, _)) => state.height_m + apart.z,
                None => self.ground_msl_m(state, frame),
            },
            sigma_m: relative.unwrap_or(absolute),
            rate_mps2,
            reference_m: system.reference_m,
            seen: matches!(reportable, Reportable::Seen(..)),
            number: u8::try_from(index).unwrap_or(u8::MAX),
            sighting: self.sighting(*t, state, down),
            size_m: system.size_m,
            in_picture: system.in_picture,
        };
        report.is_finite().then_some(report)
    }

    fn sighting(&self, t: MonoTime, state: &TargetState, down: f64) -> Option<Sighting> {
        let own = self.helicopter.at(t)?;
        let at = nalgebra::Vector3::new(state.north_m, state.east_m, down);
        Some(Sighting {
            at: self.since_start(t),
            offset_ned_m: at - own.position_ned_m,
            ned_from_body: own.ned_from_body,
            heading_rad: state.heading_rad,
            sigma_m: (state.relative_sigma_m.unwrap_or(f64::NAN), own.sigma_down_m),
        })
    }

    /// Altitude of the ground under a vehicle above mean sea level: of level ground as configured, else by the geoid,
    /// plus the terrain's difference there. Where the receiver reports no geoid, the height above the ellipsoid is
    /// used.
    fn ground_msl_m(&self, state: &TargetState, frame: &LocalFrame) -> f64 {
        let datum_m = frame.datum().height_m;
        let level = self.elevation_msl_m.unwrap_or_else(|| datum_m - self.geoid_m.unwrap_or(0.0));
        level + state.height_m - datum_m
    }

    fn put_state(&mut self, index: usize, report: &VehicleReport, now: MonoTime, out: &mut Vec<Vec<u8>>) {
        use MavlinkMessage as M;
        let down_m = self.frame.map_or(0.0, |frame| frame.datum().height_m - report.state.height_m);
        let landing = self.config.landing_frame;
        for kind in self.config.messages.clone() {
            let seen = report.sighting.as_ref().filter(|_| report.seen);
            match kind {
                M::GlobalPositionInt => self.put(index, &messages::global_position_int(report), now, out),
                M::Attitude => self.put(index, &messages::attitude(report), now, out),
                M::FollowTarget => self.put(index, &messages::follow_target(report), now, out),
                M::Odometry => self.put(index, &messages::odometry(report, down_m), now, out),
                M::TargetAbsolute => self.put_camera(&messages::target_absolute(report), now, out),
                M::TargetRelative => {
                    let message = seen.map(|seen| messages::target_relative(report, seen));
                    message.into_iter().for_each(|message| self.put_camera(&message, now, out));
                }
                M::LandingTarget => {
                    let message = seen.map(|seen| messages::landing_target(report, seen, landing));
                    message.into_iter().for_each(|message| self.put_camera(&message, now, out));
                }
                M::CameraTrackingGeoStatus if index == 0 => {
                    self.put_camera(&messages::camera_tracking_geo_status(report), now, out);
                }
                M::CameraTrackingImageStatus if index == 0 => {
                    self.put_camera(&messages::camera_tracking_image_status(report), now, out);
                }
                M::CameraTrackingGeoStatus | M::CameraTrackingImageStatus => {}
            }
        }
    }

    /// Whether a tracking camera is shown to ground stations.
    fn has_camera(&self) -> bool {
        self.config.messages.iter().any(|message| {
            matches!(
                message,
                MavlinkMessage::CameraTrackingGeoStatus | MavlinkMessage::CameraTrackingImageStatus
            )
        })
    }

    /// Answers a command of a ground station to the camera.
    pub fn asked(&mut self, from: Sender, message: &MavMessage, now: MonoTime, out: &mut Vec<Vec<u8>>) {
        if !self.has_camera() {
            return;
        }
        let answers = self.camera.answers(from, self.config.autopilot_id, message, self.since_start(now));
        answers.iter().for_each(|answer| self.put_camera(answer, now, out));
    }

    /// A message of a target, under its own system id.
    fn put(&mut self, index: usize, message: &MavMessage, now: MonoTime, out: &mut Vec<Vec<u8>>) {
        let sender = Sender { system: self.system_id(index), component: VEHICLE };
        let sequence = self.systems[index].sequence;
        self.systems[index].sequence = sequence.wrapping_add(1);
        out.push(self.encode(sequence, sender, message, now));
    }

    /// A message of the helicopter's camera.
    fn put_camera(&mut self, message: &MavMessage, now: MonoTime, out: &mut Vec<Vec<u8>>) {
        let sender = Sender { system: self.config.autopilot_id, component: CAMERA };
        let sequence = self.camera.next_sequence();
        out.push(self.encode(sequence, sender, message, now));
    }

    fn encode(&mut self, sequence: u8, sender: Sender, message: &MavMessage, now: MonoTime) -> Vec<u8> {
        let utc = self.utc(now);
        let signature = match (&self.key, utc) {
            (Some(key), Some(utc)) => {
                // Never the same or an earlier stamp, whatever the clock does.
                self.stamp = packet::time_stamp(utc).max(self.stamp + 1);
                Some(Signature { key, link_id: self.config.signing_link_id, time_stamp: self.stamp })
            }
            _ => None,
        };
        packet::encode(sequence, sender, message, signature)
    }
}

/// The detector's identity of a configured marker.
fn seen_as(marker: &MarkerConfig, target: usize, index: usize) -> MarkerId {
    match (marker.family, marker.id) {
        (Some(family), Some(id)) => MarkerId::Tag { family, id },
        _ => MarkerId::Disc { target, marker: index },
    }
}

/// The track status for a heartbeat: active while positions of a visible vehicle are sent, critical while predicted
/// ones are, and standby where none are.
fn status(reportable: &Reportable) -> TrackStatus {
    match reportable {
        Reportable::Seen(..) => TrackStatus::Tracking,
        Reportable::Predicted(..) => TrackStatus::Coasting,
        Reportable::Nothing => TrackStatus::Lost,
    }
}
