//! All sensors together, as values in order of reception.

use std::sync::Arc;

use nalgebra::{Matrix2, Vector2, Vector3};

use super::camera::{Exposures, FrameTruth, MarkerTruth};
use super::company::Appearance;
use super::compass::{Compass, CompassSample};
use super::gnss::{GnssReceiver, GnssSample};
use super::random::{Purpose, Stream};
use super::world::World;
use windhover_base::msg::{
    AttitudeSample, FeatureTrack, FrameObservations, GnssEpoch, MarkerDetection, MarkerId, Stamped,
};
use windhover_base::settings::MarkerKind;
use windhover_base::time::{MonoTime, Span};

/// Bytes of one epoch's sentences (RMC, GGA, PGRME, PGRMV) and of one compass sentence on the wire.
const WIRE_BYTES: (f64, f64) = (223.0, 20.0);

/// One measurement with its true time. `t_valid` is computed with the configured latency: it is off by this flight's
/// latency error and the remaining jitter.
#[derive(Clone, Copy, PartialEq, Debug)]
#[expect(clippy::large_enum_variant, reason = "a value at a time, handed on")]
pub enum Sample {
    /// A GPS epoch.
    Gnss {
        /// When it was true.
        t_true: MonoTime,
        /// As the pipeline would stamp it.
        stamped: Stamped<GnssEpoch>,
    },
    /// A compass reading.
    Attitude {
        /// When it was true.
        t_true: MonoTime,
        /// As the pipeline would stamp it.
        stamped: Stamped<AttitudeSample>,
    },
    /// A frame: what is seen in it is [`SensorSuite::observations`] until the next sample.
    Frame {
        /// Its number and times; `t_stamp` with the configured offset is its time of validity.
        truth: FrameTruth,
        /// Position in the stream of samples.
        seq: u64,
    },
}

impl Sample {
    /// Its reception.
    pub fn t_recv(&self) -> MonoTime {
        match self {
            Self::Gnss { stamped, .. } => stamped.t_recv,
            Self::Attitude { stamped, .. } => stamped.t_recv,
            Self::Frame { truth, .. } => truth.t_recv,
        }
    }
}

/// Share of the features that are found on what moves in view, where something does.
const RIDERS: f64 = 1.0 / 3.0;

/// A point being followed: of the ground, or of the body of a companion.
#[derive(Clone, Copy, Debug)]
struct Followed {
    id: u64,
    at_m: Vector3<f64>,
    on: Option<usize>,
}

impl Followed {
    fn ned(&self, world: &World, t: MonoTime) -> Vector3<f64> {
        self.on.map_or(self.at_m, |mover| world.mover(mover, t).ned_of(&self.at_m))
    }
}

/// The sensors of one flight. An iterator of [`Sample`]s in order of arrival; nothing is allocated
/// from one sample to the next once the buffers have grown.
///
/// ```
/// use std::sync::Arc;
/// use windhover_simulate::{Sample, Scenario, SensorSuite, World};
///
/// let mut scenario = Scenario::named("hover10").expect("a named scenario");
/// scenario.duration_s = 2.0;
/// let world = Arc::new(World::new(scenario, 7));
/// let mut suite = SensorSuite::new(Arc::clone(&world));
/// let (mut fixes, mut seen) = (0, 0);
/// while let Some(sample) = suite.next() {
///     match sample {
///         Sample::Gnss { .. } => fixes += 1,
///         Sample::Attitude { .. } => {}
///         Sample::Frame { .. } => seen += suite.observations().markers.len(),
///     }
/// }
/// assert!(fixes > 5 && seen > 20, "{fixes} fixes, {seen} markers");
/// ```
#[derive(Clone, Debug)]
pub struct SensorSuite {
    world: Arc<World>,
    gnss: (GnssReceiver, Option<GnssSample>),
    compass: (Compass, Option<CompassSample>),
    exposures: (Exposures, Option<FrameTruth>),
    markers: Stream,
    features: Stream,
    riders: Stream,
    followed: Vec<Option<Followed>>,
    next_id: u64,
    seq: u64,
    last_frame: Option<MonoTime>,
    observations: FrameObservations,
    truths: Vec<MarkerTruth>,
}

impl SensorSuite {
    /// The sensors of a flight through this world.
    pub fn new(world: Arc<World>) -> Self {
        let seed = world.seed();
        let (mut gnss, mut compass) = (GnssReceiver::new(&world), Compass::new(&world));
        let mut exposures = Exposures::new(seed);
        let first = (gnss.next(&world), compass.next(&world), exposures.next(&world));
        let features = world.scenario().camera.features;
        Self {
            gnss: (gnss, first.0),
            compass: (compass, first.1),
            exposures: (exposures, first.2),
            markers: Stream::of(seed, Purpose::Markers),
            features: Stream::of(seed, Purpose::Features),
            riders: Stream::of(seed, Purpose::Riders),
            followed: vec![None; features],
            next_id: 0,
            seq: 0,
            last_frame: None,
            observations: FrameObservations::default(),
            truths: Vec::new(),
            world,
        }
    }

    /// The world they measure.
    pub fn world(&self) -> &Arc<World> {
        &self.world
    }

    /// What was seen in the frame last returned.
    pub fn observations(&self) -> &FrameObservations {
        &self.observations
    }

    /// Every marker in front of the camera in the frame last returned, as it truly projects.
    pub fn marker_truths(&self) -> &[MarkerTruth] {
        &self.truths
    }

    /// This flight's true GPS latency minus the configured one.
    pub fn gps_latency_error(&self) -> Span {
        self.gnss.0.latency_error(self.world.scenario())
    }

    /// This flight's true compass latency minus the configured one.
    pub fn compass_latency_error(&self) -> Span {
        self.compass.0.latency_error(self.world.scenario())
    }

    /// This flight's constant heading error of the compass, radians: reported minus true.
    pub fn compass_bias_rad(&self) -> f64 {
        self.compass.0.bias_rad()
    }

    fn gnss_sample(&mut self, sample: &GnssSample, t_recv: MonoTime) -> Sample {
        self.gnss.1 = self.gnss.0.next(&self.world);
        let scenario = self.world.scenario();
        let t_valid = sample.t_true + self.gnss.0.latency_error(scenario) + self.gnss.0.stamp_noise(scenario);
        let stamped = Stamped { t_valid, t_recv, seq: self.seq, value: sample.epoch };
        Sample::Gnss { t_true: sample.t_true, stamped }
    }

    fn compass_sample(&mut self, sample: &CompassSample, t_recv: MonoTime) -> Sample {
        self.compass.1 = self.compass.0.next(&self.world);
        let t_valid = sample.t_first_byte - Span::from_ms(self.world.scenario().rig.compass.latency_ms);
        let stamped = Stamped { t_valid, t_recv, seq: self.seq, value: sample.sample };
        Sample::Attitude { t_true: sample.t_true, stamped }
    }

    fn frame_sample(&mut self, truth: &FrameTruth) -> Sample {
        self.exposures.1 = self.exposures.0.next(&self.world);
        self.observations.frame = truth.frame;
        self.observations.markers.clear();
        self.observations.features.clear();
        self.truths.clear();
        self.see_markers(truth.t_true);
        self.see_ground(truth.t_true);
        self.last_frame = Some(truth.t_true);
        Sample::Frame { truth: *truth, seq: self.seq }
    }

    fn see_markers(&mut self, t: MonoTime) {
        let world = Arc::clone(&self.world);
        for mover in 0..world.movers() {
            let (target, looks) = match world.looks(mover).1 {
                None => (mover, None),
                Some(Appearance::Double) => (0, Some(Appearance::Double)),
                Some(_) => continue,
            };
            for marker in 0..world.rig().target[target].marker.len() {
                let Some(truth) = world.marker_on(mover, target, marker, t) else { continue };
                if looks.is_none() {
                    self.truths.push(truth);
                }
                if let Some(seen) = see_marker(&world, &mut self.markers, &truth) {
                    self.observations.markers.push(seen);
                }
            }
        }
    }

    /// A point on something that moves along, now and then.
    fn rider(&mut self) -> Option<Followed> {
        let first = self.world.vehicles();
        let companions = self.world.movers() - first;
        if companions == 0 {
            return None;
        }
        let rides = self.riders.chance(RIDERS);
        let on = first + self.riders.uniform(0.0, companions as f64) as usize;
        let place = [self.riders.uniform(-1.0, 1.0), self.riders.uniform(-1.0, 1.0)];
        // On top of a person or on the roof.
        let (half, height) = match self.world.looks(on).1 {
            Some(Appearance::Person) => ((0.15, 0.2), 1.6),
            _ => ((0.5, 0.3), 0.55),
        };
        let at_m = Vector3::new(half.0 * place[0], half.1 * place[1], -height);
        rides.then_some(Followed { id: self.next_id, at_m, on: Some(on) })
    }

    /// Follows ground points: those out of view or under a vehicle are given up, others found, each
    /// slot in its own part of the frame.
    fn see_ground(&mut self, t: MonoTime) {
        let world = Arc::clone(&self.world);
        let (sim, camera) = (&world.scenario().camera, &world.scenario().rig.camera);
        let pose = world.camera_pose(t);
        let gap_s = self.last_frame.map_or(0.0, |last| (t - last).s());
        let columns = (self.followed.len() as f64).sqrt().ceil().max(1.0) as usize;
        let rows = self.followed.len().div_ceil(columns).max(1);
        for slot in 0..self.followed.len() {
            let rider = self.rider();
            let followed = &mut self.followed[slot];
            let lost = self.features.chance(1.0 - (-gap_s / sim.feature_life_s.max(1e-3)).exp());
            let place = (self.features.uniform(0.05, 0.95), self.features.uniform(0.05, 0.95));
            let noise = Vector2::new(self.features.normal(), self.features.normal());
            // Nothing is followed over a gap of more than half a second.
            if lost || gap_s > 0.5 {
                *followed = None;
            }
            let in_view = |point: &Followed| -> Option<Vector2<f64>> {
                let px = world.seen(t, |t| point.ned(&world, t))?;
                let hidden = point.on.is_none() && world.covered_by_vehicle(&point.at_m, t);
                (world.in_frame(&px, 8.0) && !hidden).then_some(px)
            };
            let mut px = followed.as_ref().and_then(in_view);
            if px.is_none() {
                let (column, row) = (slot % columns, slot / columns);
                let u = (column as f64 + place.0) / columns as f64 * f64::from(camera.width);
                let v = (row as f64 + place.1) / rows as f64 * f64::from(camera.height);
                let ground = world.ground_at(&pose, Vector2::new(u, v));
                let ground = ground.map(|at_m| Followed { id: self.next_id, at_m, on: None });
                *followed = rider.filter(|rider| in_view(rider).is_some()).or(ground);
                px = followed.as_ref().and_then(in_view);
                if px.is_some() {
                    self.next_id += 1;
                } else {
                    *followed = None;
                }
            }
            if let (Some(px), Some(f)) = (px, followed.as_ref()) {
                let px = px + noise * sim.feature_noise_px;
                let sigma_px = sim.feature_noise_px.max(1e-3);
                self.observations.features.push(FeatureTrack { id: f.id, px, sigma_px });
            }
        }
    }
}

/// A marker as a detector of the scenario's quality reports it; `None` where it is not seen.
fn see_marker(world: &World, stream: &mut Stream, truth: &MarkerTruth) -> Option<MarkerDetection> {
    let sim = &world.scenario().camera;
    // Every figure is drawn whether it is used or not, so that runs stay comparable.
    let noise: [Vector2<f64>; 4] =
        std::array::from_fn(|_| Vector2::new(stream.normal(), stream.normal()) * sim.marker_noise_px);
    let missed = stream.chance(sim.marker_missed);
    let gross = stream.chance(sim.marker_outlier);
    let (bearing, reach_px) = (stream.uniform(0.0, std::f64::consts::TAU), stream.uniform(15.0, 60.0));
    if missed || !truth.visible {
        return None;
    }
    let shift = match gross {
        true => Vector2::new(bearing.cos(), bearing.sin()) * reach_px,
        false => Vector2::zeros(),
    };
    let config = &world.rig().target[truth.target].marker[truth.marker];
    let edges = [(0, 1), (1, 2), (2, 3), (3, 0)].map(|(a, b)| {
        let (a, b): (usize, usize) = (a, b);
        (truth.corners_px[a] - truth.corners_px[b]).norm()
    });
    let variance = Matrix2::identity() * sim.marker_noise_px.max(1e-3).powi(2);
    let is_tag = config.kind == MarkerKind::Apriltag;
    let corners: [Vector2<f64>; 4] = std::array::from_fn(|k| truth.corners_px[k] + noise[k] + shift);
    let mean_noise: Vector2<f64> = noise.iter().sum::<Vector2<f64>>() / 4.0;
    let (marker, center_noise, center_cov) = match (config.kind, config.family, config.id) {
        (MarkerKind::Apriltag, Some(family), Some(id)) => {
            (MarkerId::Tag { family, id }, mean_noise, variance / 4.0)
        }
        _ => (MarkerId::Disc { target: truth.target, marker: truth.marker }, noise[0], variance),
    };
    Some(MarkerDetection {
        marker,
        center_px: truth.center_px + center_noise + shift,
        center_cov_px2: center_cov,
        corners_px: is_tag.then_some(corners),
        corner_cov_px2: if is_tag { [variance; 4] } else { [Matrix2::zeros(); 4] },
        hamming: 0,
        margin: 60.0,
        size_px: edges.iter().sum::<f64>() / 4.0,
    })
}

impl Iterator for SensorSuite {
    type Item = Sample;

    fn next(&mut self) -> Option<Sample> {
        let rig = &self.world.scenario().rig;
        let line = |bytes: f64, baud: u32| Span::from_s(bytes * 10.0 / f64::from(baud));
        let (gnss, compass, frame) = (self.gnss.1, self.compass.1, self.exposures.1);
        let arrivals = [
            gnss.map(|s| s.t_first_byte + line(WIRE_BYTES.0, rig.gps.baud)),
            compass.map(|s| s.t_first_byte + line(WIRE_BYTES.1, rig.compass.baud)),
            frame.map(|f| f.t_recv),
        ];
        let t_recv = arrivals.iter().flatten().min().copied()?;
        let sample = match (gnss, compass, frame) {
            (Some(sample), _, _) if arrivals[0] == Some(t_recv) => self.gnss_sample(&sample, t_recv),
            (_, Some(sample), _) if arrivals[1] == Some(t_recv) => self.compass_sample(&sample, t_recv),
            (_, _, Some(truth)) => self.frame_sample(&truth),
            _ => return None,
        };
        self.seq += 1;
        Some(sample)
    }
}
