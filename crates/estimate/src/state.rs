//! The joint state: helicopter, sensors' slow errors, targets, ground features, their covariance, and
//! the delayed copies that make the smoothed output.

use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};

use windhover_base::msg::TrackStatus;
use windhover_base::time::{MonoTime, Span};

use super::learn::Learnt;
use super::matrix::Grid;

/// Places of the helicopter's part in the error state.
pub(super) mod at {
    /// Position of the body frame's origin, NED, m.
    pub(in super::super) const POSITION: usize = 0;
    /// Its velocity, NED, m/s.
    pub(in super::super) const VELOCITY: usize = 3;
    /// Attitude error: small rotation about the NED axes, `R = exp(δ) R̂`, rad.
    pub(in super::super) const ATTITUDE: usize = 6;
    /// Angular rate in the body frame, rad/s.
    pub(in super::super) const RATE: usize = 9;
    /// Specific force in the body frame, m/s².
    pub(in super::super) const FORCE: usize = 12;
    /// GPS position bias, NED, m.
    pub(in super::super) const GPS_BIAS: usize = 15;
    /// Compass heading bias, rad.
    pub(in super::super) const HEADING_BIAS: usize = 18;
    /// How much of the true tilt the compass reads.
    pub(in super::super) const TILT_GAIN: usize = 19;
    /// Tilt bias (pitch, roll), rad.
    pub(in super::super) const TILT_BIAS: usize = 20;
    /// How much older GPS is than configured, s.
    pub(in super::super) const GPS_DELAY: usize = 22;
    /// Drag: acceleration per metre a second through the air, 1/s.
    pub(in super::super) const DRAG: usize = 23;
    /// Length of the helicopter's part.
    pub(in super::super) const OWN: usize = 24;
    /// Length of a target's part: north, east, heading, speed, yaw rate.
    pub(in super::super) const TARGET: usize = 5;
    /// Length of a feature's part: north, east.
    pub(in super::super) const FEATURE: usize = 2;
}

/// Variance of the place of something just found, m². Its guess is made from where the helicopter is thought to be, so
/// as a prior it must tell nothing of where that is: with 30 m each new ground feature told a little, and a
/// thousand of them twice what the receiver does.
pub(super) const GUESSED_VAR: f64 = 1e5;

/// Standard gravity, m/s².
pub(super) const GRAVITY: f64 = 9.806_65;

/// The helicopter and its sensors' slow errors.
#[derive(Clone, Copy, Debug)]
pub(super) struct Own {
    pub(super) position: Vector3<f64>,
    pub(super) velocity: Vector3<f64>,
    pub(super) ned_from_body: Rotation3<f64>,
    pub(super) rate: Vector3<f64>,
    pub(super) force: Vector3<f64>,
    pub(super) gps_bias: Vector3<f64>,
    pub(super) heading_bias: f64,
    pub(super) tilt_gain: f64,
    pub(super) tilt_bias: Vector2<f64>,
    pub(super) gps_delay_s: f64,
    pub(super) drag_per_s: f64,
}

impl Default for Own {
    fn default() -> Self {
        Self {
            position: Vector3::zeros(),
            velocity: Vector3::zeros(),
            ned_from_body: Rotation3::identity(),
            rate: Vector3::zeros(),
            force: Vector3::new(0.0, 0.0, -GRAVITY),
            gps_bias: Vector3::zeros(),
            heading_bias: 0.0,
            tilt_gain: 1.0,
            tilt_bias: Vector2::zeros(),
            gps_delay_s: 0.0,
            drag_per_s: 0.0,
        }
    }
}

impl Own {
    /// Acceleration in NED: `R f + g − c v`, where the drag of the wind is part of f.
    pub(super) fn acceleration(&self) -> Vector3<f64> {
        self.ned_from_body * self.force + Vector3::new(0.0, 0.0, GRAVITY) - self.velocity * self.drag_per_s
    }

    /// `ned_from_body` as a matrix.
    pub(super) fn rotation(&self) -> &Matrix3<f64> {
        self.ned_from_body.matrix()
    }

    fn is_finite(&self) -> bool {
        let scalars = [self.heading_bias, self.tilt_gain, self.gps_delay_s, self.drag_per_s];
        let vectors = [&self.position, &self.velocity, &self.rate, &self.force, &self.gps_bias];
        vectors.iter().all(|v| v.iter().all(|x| x.is_finite()))
            && scalars.iter().all(|x| x.is_finite())
            && self.tilt_bias.iter().all(|x| x.is_finite())
            && self.rotation().iter().all(|x| x.is_finite())
    }
}

/// One vehicle: rear axle north, east, heading, speed, yaw rate, and its track.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Target {
    pub(super) held: bool,
    pub(super) mean: [f64; at::TARGET],
    pub(super) status: TrackStatus,
    pub(super) last_seen: MonoTime,
    /// Frames it was seen in since it was last started.
    pub(super) seen: u32,
    /// Sliding mean of the test that it stands still; see `learn_rest`.
    pub(super) motion: f64,
    /// Over how long the filter remembers its speed and its yaw rate, s, and did when their walks were last fitted
    /// (zero where they have not been).
    pub(super) memory_s: [f64; 2],
    pub(super) fitted_memory_s: [f64; 2],
    /// When the present track was (last) started: nothing ties it to copies from before.
    pub(super) started: MonoTime,
    /// When and where (north, east) it was first seen since it was last unknown.
    pub(super) first_seen: (MonoTime, [f64; 2]),
    /// Frames in a row in which its markers lay outside the gate.
    pub(super) rejected: u32,
    /// Whether its place was read off its markers anew, and nothing has confirmed it since.
    pub(super) placed_anew: bool,
}

/// One ground feature.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Feature {
    pub(super) id: Option<u64>,
    pub(super) mean: [f64; at::FEATURE],
    pub(super) rejected: u32,
}

/// A copy of some states as they were at one instant, kept up with all that is measured after it.
///
/// Only its own covariance and that with the present state are needed: fixed-point smoothing.
#[derive(Clone, Debug, Default)]
pub(super) struct Echo {
    pub(super) live: bool,
    pub(super) t: MonoTime,
    pub(super) frame: u32,
    pub(super) mean: Vec<f64>,
    pub(super) cov: Grid,
    pub(super) cross: Grid,
    pub(super) status: Vec<TrackStatus>,
    /// Speed and yaw rate of each target as the filter told them then, with their variances.
    pub(super) told: Vec<[(f64, f64); 2]>,
}

impl Echo {
    fn new(states: usize, n: usize, targets: usize) -> Self {
        Self {
            live: false,
            t: MonoTime::default(),
            frame: 0,
            mean: vec![0.0; states],
            cov: Grid::zeros(states, states),
            cross: Grid::zeros(states, n),
            status: vec![TrackStatus::Lost; targets],
            told: vec![[(0.0, 0.0); 2]; targets],
        }
    }

    fn copy_from(&mut self, other: &Self) {
        self.live = other.live;
        if !other.live {
            return;
        }
        self.t = other.t;
        self.frame = other.frame;
        self.mean.clone_from(&other.mean);
        self.cov.copy_from(&other.cov);
        self.cross.copy_from(&other.cross);
        self.status.clone_from(&other.status);
        self.told.clone_from(&other.told);
    }
}

/// Measurements in a row outside the gate, per source of the helicopter's own.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Rejections {
    pub(super) gps_position: u32,
    /// Horizontal error of the receiver that the last fix implied, m.
    pub(super) gps_error: Vector2<f64>,
    pub(super) gps_velocity: u32,
    pub(super) heading: u32,
    pub(super) tilt: u32,
}

/// The whole filter state at one instant.
#[derive(Clone, Debug, Default)]
pub(super) struct State {
    pub(super) t: MonoTime,
    /// Whether the helicopter's own state is known.
    pub(super) alive: bool,
    pub(super) own: Own,
    pub(super) targets: Vec<Target>,
    pub(super) features: Vec<Feature>,
    pub(super) cov: Grid,
    /// Targets as they were at recent frames.
    pub(super) echoes: Vec<Echo>,
    /// Rates and forces as they were a moment ago, to learn their intensity from.
    pub(super) probe: Echo,
    pub(super) learnt: Learnt,
    pub(super) rejections: Rejections,
    /// When the scene was last anchored anew, and by how much it moved.
    pub(super) anchored: Option<(MonoTime, Vector3<f64>)>,
}

/// States of the probe: rate and specific force.
pub(super) const PROBE: usize = 6;

impl State {
    pub(super) fn new(targets: usize, features: usize, echoes: usize, learnt: Learnt) -> Self {
        let n = at::OWN + at::TARGET * targets + at::FEATURE * features;
        Self {
            targets: vec![Target::default(); targets],
            features: vec![Feature::default(); features],
            cov: Grid::zeros(n, n),
            echoes: vec![Echo::new(at::TARGET * targets, n, targets); echoes],
            probe: Echo::new(PROBE, n, 0),
            learnt,
            ..Self::default()
        }
    }

    /// Copies without allocating where the sizes match.
    pub(super) fn copy_from(&mut self, other: &Self) {
        self.copy_present(other);
        self.echoes.resize_with(other.echoes.len(), Echo::default);
        for (mine, theirs) in self.echoes.iter_mut().zip(&other.echoes) {
            mine.copy_from(theirs);
        }
        self.probe.copy_from(&other.probe);
        self.rejections = other.rejections;
        self.anchored = other.anchored;
    }

    /// Copies all but the delayed copies, to look ahead with; without allocating where the sizes match.
    pub(super) fn copy_present(&mut self, other: &Self) {
        self.t = other.t;
        self.alive = other.alive;
        self.own = other.own;
        self.targets.clone_from(&other.targets);
        self.features.clone_from(&other.features);
        self.cov.copy_from(&other.cov);
        self.learnt.copy_from(&other.learnt);
    }

    /// Length of the error state.
    pub(super) fn len(&self) -> usize {
        self.cov.rows()
    }

    /// Where target `i` begins.
    pub(super) fn target_at(&self, i: usize) -> usize {
        debug_assert!(i < self.targets.len());
        at::OWN + at::TARGET * i
    }

    /// Where feature `i` begins.
    pub(super) fn feature_at(&self, i: usize) -> usize {
        at::OWN + at::TARGET * self.targets.len() + at::FEATURE * i
    }

    /// Forgets `len` states from `start` and gives them variances of their own.
    pub(super) fn renew(&mut self, start: usize, variances: &[f64]) {
        self.cov.forget(start, variances.len());
        for (i, variance) in variances.iter().enumerate() {
            self.cov.set(start + i, start + i, *variance);
        }
        let columns = start..start + variances.len();
        for echo in self.echoes.iter_mut().chain([&mut self.probe]).filter(|e| e.live) {
            for i in 0..echo.cross.rows() {
                echo.cross.row_mut(i)[columns.clone()].fill(0.0);
            }
        }
    }

    /// Moves the mean by an error-state step.
    pub(super) fn inject(&mut self, dx: &[f64]) {
        let three = |i: usize| Vector3::new(dx[i], dx[i + 1], dx[i + 2]);
        let own = &mut self.own;
        own.position += three(at::POSITION);
        own.velocity += three(at::VELOCITY);
        own.ned_from_body = Rotation3::new(three(at::ATTITUDE)) * own.ned_from_body;
        own.rate += three(at::RATE);
        own.force += three(at::FORCE);
        own.gps_bias += three(at::GPS_BIAS);
        own.heading_bias += dx[at::HEADING_BIAS];
        own.tilt_gain += dx[at::TILT_GAIN];
        own.tilt_bias += Vector2::new(dx[at::TILT_BIAS], dx[at::TILT_BIAS + 1]);
        own.gps_delay_s += dx[at::GPS_DELAY];
        own.drag_per_s += dx[at::DRAG];
        let mut rest = &dx[at::OWN..];
        for target in &mut self.targets {
            let (mine, others) = rest.split_at(at::TARGET);
            target.mean.iter_mut().zip(mine).for_each(|(x, d)| *x += d);
            rest = others;
        }
        for (feature, mine) in self.features.iter_mut().zip(rest.chunks_exact(at::FEATURE)) {
            feature.mean.iter_mut().zip(mine).for_each(|(x, d)| *x += d);
        }
    }

    /// Carries the covariance over to the estimate that an update has just moved by `dx`.
    ///
    /// What is seen of vehicles and ground says nothing of absolute heading: turning helicopter,
    /// velocity and everything seen about the vertical together changes no pixel. In error states
    /// that direction is `(e_D × p̂, e_D × v̂, 1, e_D × f̂, …)`; it depends on the estimate, so an update
    /// that moves p̂ by Δ leaves the covariance with the old one, and the filter gains heading it never
    /// measured. Adding `e_D × Δ` times the heading error to each horizontal vector's error keeps the
    /// direction where it belongs (the error of an invariant filter, restricted to the vertical axis:
    /// Barrau and Bonnabel 2017).
    pub(super) fn keep_heading_unobserved(&mut self, dx: &[f64]) {
        let vectors = self.len();
        let turn = at::ATTITUDE + 2;
        let starts = [at::POSITION, at::VELOCITY]
            .into_iter()
            .chain((0..self.targets.len()).map(|i| at::OWN + at::TARGET * i))
            .chain((at::OWN + at::TARGET * self.targets.len()..vectors).step_by(at::FEATURE));
        for start in starts {
            let (north, east) = (-dx[start + 1], dx[start]);
            if north == 0.0 && east == 0.0 {
                continue;
            }
            self.cov.add_row_from(start, north, turn);
            self.cov.add_row_from(start + 1, east, turn);
            self.cov.add_column_from(start, north, turn);
            self.cov.add_column_from(start + 1, east, turn);
            for echo in self.echoes.iter_mut().chain([&mut self.probe]).filter(|e| e.live) {
                echo.cross.add_column_from(start, north, turn);
                echo.cross.add_column_from(start + 1, east, turn);
            }
        }
    }

    /// Whether every mean is a number and every variance a number not below zero.
    pub(super) fn is_sound(&self) -> bool {
        let diagonal = (0..self.len()).all(|i| {
            let variance = self.cov.at(i, i);
            variance.is_finite() && variance >= 0.0
        });
        diagonal && self.own.is_finite() && self.targets.iter().all(|t| t.mean.iter().all(|x| x.is_finite()))
    }

    /// Starts an echo of the targets at the present instant, in the oldest place.
    pub(super) fn echo_targets(&mut self, frame: u32, keep: Span) {
        for echo in &mut self.echoes {
            echo.live &= self.t - echo.t <= keep;
        }
        let Some(slot) = (0..self.echoes.len()).min_by_key(|i| (self.echoes[*i].live, self.echoes[*i].t, *i))
        else {
            return;
        };
        let first = at::OWN;
        let echo = &mut self.echoes[slot];
        for (i, target) in self.targets.iter().enumerate() {
            echo.mean[i * at::TARGET..][..at::TARGET].copy_from_slice(&target.mean);
            echo.status[i] = target.status;
            let column = at::OWN + at::TARGET * i + 3;
            echo.told[i] = std::array::from_fn(|k| (target.mean[3 + k], self.cov.at(column + k, column + k)));
        }
        (echo.live, echo.t, echo.frame) = (true, self.t, frame);
        take(&self.cov, echo, first);
    }

    /// Starts the probe at the present instant.
    pub(super) fn echo_own(&mut self) {
        let own = &self.own;
        for i in 0..3 {
            self.probe.mean[i] = own.rate[i];
            self.probe.mean[3 + i] = own.force[i];
        }
        (self.probe.live, self.probe.t) = (true, self.t);
        take(&self.cov, &mut self.probe, at::RATE);
    }
}

/// Copies the covariance of the states from `first` on into an echo.
fn take(cov: &Grid, echo: &mut Echo, first: usize) {
    let m = echo.mean.len();
    for i in 0..m {
        let row = cov.row(first + i);
        echo.cross.row_mut(i).copy_from_slice(row);
        echo.cov.row_mut(i).copy_from_slice(&row[first..first + m]);
    }
}
