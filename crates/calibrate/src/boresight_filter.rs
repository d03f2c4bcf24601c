//! The estimator of a boresight: helicopter, markers and mounting in one state, raw measurements in.
//!
//! A recursive least-squares pass over a flight in order of validity. Errors are small changes to the state `x ⊞ δ`;
//! Jacobians are finite differences of the measurement function, so that each model is written once.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector, Rotation3, Vector2, Vector3};

use super::boresight_state::{ATTITUDE, BASE, FIRST, MarkerState, PARAMETERS, PER_MARKER, Parameters, State};
use windhover_base::geo::{Tilt, euler_321, rot_z, wrap_angle};
use windhover_base::msg::{AttitudeSample, MarkerDetection, MarkerId};
use windhover_base::settings::{MarkerConfig, MarkerKind, Rig};

/// Jerk of the helicopter, power density, (m/s³)²/Hz: a hard stop takes a second.
const JERK: f64 = 4.0;
/// Angular acceleration, power density, (rad/s²)²/Hz: of a model helicopter in calm flight. With a larger one the noise
/// of the rates enters the compass's lateness.
const ANGULAR: f64 = 0.1;
/// Ratio of vertical to horizontal GPS error.
const VERTICAL: f64 = 1.6;
/// Least pixel noise of a corner (lens model, rolling motion), one-sigma.
const LEAST_PX: f64 = 0.15;
/// Largest normalised innovation squared for each component that is used.
const GATE: f64 = 16.0;

/// One pass over one flight.
pub(super) struct Filter<'a> {
    rig: &'a Rig,
    declination: f64,
    state: State,
    covariance: DMatrix<f64>,
    known: BTreeMap<MarkerId, usize>,
    /// Parameters at which measurements are linearised; the state's own where `None`.
    about: Option<Parameters>,
    /// Sum of squared normalised pixel residuals, and how many.
    pub(super) fit: (f64, usize),
    /// Measurements left out by the gate.
    pub(super) refused: usize,
}

impl<'a> Filter<'a> {
    /// Starts a flight at a first position, velocity and attitude, with parameters and their covariance.
    pub(super) fn new(
        rig: &'a Rig,
        declination: f64,
        (position, velocity): (Vector3<f64>, Vector3<f64>),
        ned_from_body: Rotation3<f64>,
        (parameters, sigmas): (Parameters, &DMatrix<f64>),
        about: Option<Parameters>,
    ) -> Self {
        let gps = &rig.gps;
        let h = gps.bias_sigma_m;
        let mut covariance = DMatrix::zeros(BASE, BASE);
        let start = [h + 1.0, 0.5, 2.0, h, 0.1, 0.3];
        for (block, sigma) in start.into_iter().enumerate() {
            for axis in 0..3 {
                let vertical = if axis == 2 && matches!(block, 0 | 3) { VERTICAL } else { 1.0 };
                covariance[(3 * block + axis, 3 * block + axis)] = (sigma * vertical).powi(2);
            }
        }
        covariance.view_mut((FIRST, FIRST), (PARAMETERS, PARAMETERS)).copy_from(sigmas);
        let zero = Vector3::zeros();
        let state = State {
            position,
            velocity,
            acceleration: zero,
            bias: zero,
            ned_from_body,
            rate: zero,
            parameters,
            markers: Vec::new(),
        };
        let known = BTreeMap::new();
        Self { rig, declination, state, covariance, known, about, fit: (0.0, 0), refused: 0 }
    }

    /// The parameters and their covariance.
    pub(super) fn parameters(&self) -> (Parameters, DMatrix<f64>) {
        let block = self.covariance.view((FIRST, FIRST), (PARAMETERS, PARAMETERS)).into_owned();
        (self.state.parameters, block)
    }

    /// Estimated markers: their identity, centre in NED and its one-sigma.
    pub(super) fn markers(&self) -> impl Iterator<Item = (MarkerId, Vector3<f64>, Vector3<f64>)> {
        self.known.iter().map(|(id, k)| {
            let at = BASE + PER_MARKER * k;
            let sigma = Vector3::from_fn(|axis, _| self.covariance[(at + axis, at + axis)].max(0.0).sqrt());
            (*id, self.state.markers[*k].center, sigma)
        })
    }

    /// Predicts the state by `dt` seconds.
    pub(super) fn advance(&mut self, dt: f64) {
        let n = self.state.size();
        let s = &mut self.state;
        s.position += s.velocity * dt + s.acceleration * (0.5 * dt * dt);
        s.velocity += s.acceleration * dt;
        let keep = (-dt / self.rig.gps.bias_tau_s).exp();
        s.bias *= keep;
        s.ned_from_body *= Rotation3::new(s.rate * dt);
        let mut f = DMatrix::identity(n, n);
        for axis in 0..3 {
            f[(axis, 3 + axis)] = dt;
            f[(axis, 6 + axis)] = 0.5 * dt * dt;
            f[(3 + axis, 6 + axis)] = dt;
            f[(9 + axis, 9 + axis)] = keep;
        }
        f.view_mut((ATTITUDE, 15), (3, 3)).copy_from(&(s.ned_from_body.matrix() * dt));
        let mut p = &f * &self.covariance * f.transpose();
        self.add_process_noise(&mut p, dt, keep);
        self.covariance = p;
    }

    /// White jerk through acceleration, velocity and position; white angular acceleration through rate and attitude;
    /// the random walk of the GPS bias.
    fn add_process_noise(&self, p: &mut DMatrix<f64>, dt: f64, keep: f64) {
        let sigma = self.rig.gps.bias_sigma_m;
        // Integral of the chain's response: [dt⁵/20 dt⁴/8 dt³/6; · dt³/3 dt²/2; · · dt].
        let chain = [
            [dt.powi(5) / 20.0, dt.powi(4) / 8.0, dt.powi(3) / 6.0],
            [dt.powi(4) / 8.0, dt.powi(3) / 3.0, dt * dt / 2.0],
            [dt.powi(3) / 6.0, dt * dt / 2.0, dt],
        ];
        for axis in 0..3 {
            let vertical = if axis == 2 { VERTICAL } else { 1.0 };
            for (row, terms) in chain.iter().enumerate() {
                for (column, term) in terms.iter().enumerate() {
                    p[(3 * row + axis, 3 * column + axis)] += JERK * term;
                }
            }
            p[(9 + axis, 9 + axis)] += (sigma * vertical).powi(2) * (1.0 - keep * keep);
            p[(15 + axis, 15 + axis)] += ANGULAR * dt;
            p[(ATTITUDE + axis, ATTITUDE + axis)] += ANGULAR * dt.powi(3) / 3.0;
            for body in 0..3 {
                let cross = self.state.ned_from_body.matrix()[(axis, body)] * ANGULAR * dt * dt / 2.0;
                p[(ATTITUDE + axis, 15 + body)] += cross;
                p[(15 + body, ATTITUDE + axis)] += cross;
            }
        }
    }

    /// Takes a measurement: residual (measured minus expected) as a function of the state, noise variances, and the
    /// states it depends on. Returns false where the gate refused it.
    fn update(
        &mut self,
        residual: &dyn Fn(&State) -> Option<DVector<f64>>,
        noise: &[f64],
        axes: &[usize],
    ) -> bool {
        let mut point = self.state.clone();
        point.parameters = self.about.unwrap_or(self.state.parameters);
        let Some(mut r) = residual(&point) else { return false };
        let (m, n) = (noise.len(), self.state.size());
        let mut h = DMatrix::zeros(m, n);
        for &axis in axes {
            let step = 1e-5;
            let Some(moved) = residual(&point.moved(axis, step)) else { return false };
            h.set_column(axis, &((&r - moved) / step));
        }
        // The residual at the state's own parameters, from the derivative at the linearisation point.
        for (k, own) in self.state.parameters.iter().enumerate() {
            r -= h.column(FIRST + k) * (own - point.parameters[k]);
        }
        let ph = &self.covariance * h.transpose();
        let s = &h * &ph + DMatrix::from_diagonal(&DVector::from_column_slice(noise));
        let Some(chol) = s.cholesky() else { return false };
        let weighted = chol.solve(&r);
        if !(r.dot(&weighted) < GATE * m as f64) {
            self.refused += 1;
            return false;
        }
        let change = &ph * weighted;
        let turning = self.state.turning();
        for axis in 0..n {
            self.state.add(axis, change[axis]);
        }
        let mut p = &self.covariance - &ph * chol.solve(&ph.transpose());
        p = (&p + p.transpose()) * 0.5;
        self.covariance = p;
        self.shear(&(self.state.turning() - turning));
        true
    }

    /// Pixels do not observe a rotation of everything about the vertical. Earlier measurements were linearised at
    /// earlier states; as the state moves, the unobserved direction moves with it (`P ← T P Tᵀ`, `T = I + d eᵀ`, `e`
    /// the yaw). Without this the filter becomes confident of a yaw that no measurement observed.
    fn shear(&mut self, d: &DVector<f64>) {
        let yaw = ATTITUDE + 2;
        let column = self.covariance.column(yaw).into_owned();
        let variance = column[yaw];
        self.covariance += d * column.transpose() + &column * d.transpose() + d * d.transpose() * variance;
    }

    /// GPS position in NED: of the antenna, with the slow bias, late by the GPS parameter.
    pub(super) fn gps_position(&mut self, measured: Vector3<f64>, sigma: f64) {
        let antenna = Vector3::from(self.rig.gps.antenna_position_m);
        let expect = move |s: &State| {
            let late = s.parameters[10];
            let at = s.position - s.velocity * late + s.ned_from_body * antenna + s.bias;
            Some(DVector::from_column_slice((measured - at).as_slice()))
        };
        let v = sigma * sigma;
        let axes: Vec<usize> = (0..18).chain([FIRST + 10]).collect();
        self.update(&expect, &[v, v, v * VERTICAL * VERTICAL], &axes);
    }

    /// GPS velocity in NED; two components where down is not known.
    pub(super) fn gps_velocity(&mut self, measured: &[f64]) {
        let antenna = Vector3::from(self.rig.gps.antenna_position_m);
        let expect = |s: &State| {
            let late = s.parameters[10];
            let v = s.velocity - s.acceleration * late + s.ned_from_body * s.rate.cross(&antenna);
            Some(DVector::from_iterator(measured.len(), measured.iter().zip(v.iter()).map(|(m, v)| m - v)))
        };
        let v = self.rig.gps.velocity_noise_mps.powi(2);
        let noise = [v, v, 2.25 * v];
        let axes: Vec<usize> = (3..9).chain(12..18).chain([FIRST + 10]).collect();
        self.update(&expect, &noise[..measured.len()], &axes);
    }

    /// A compass reading: heading and tilt with their zeros, late by the compass parameter.
    pub(super) fn compass(&mut self, sample: &AttitudeSample) {
        let compass = &self.rig.compass;
        let declination = if sample.heading_is_true { 0.0 } else { self.declination };
        let offset = compass.yaw_offset_deg.to_radians();
        let convention = compass.angles;
        let zero =
            Tilt { pitch: compass.pitch_offset_deg.to_radians(), roll: compass.roll_offset_deg.to_radians() };
        let seen = |s: &State| s.ned_from_body * Rotation3::new(-s.rate * s.parameters[9]);
        let axes: Vec<usize> = (12..18).chain(FIRST + 6..FIRST + 10).collect();
        if let Some(heading) = sample.heading {
            let expect = |s: &State| {
                let truth = euler_321(&seen(s)).0;
                let reported = truth - declination - offset + s.parameters[6];
                Some(DVector::from_element(1, wrap_angle(heading - reported)))
            };
            self.update(&expect, &[compass.heading_noise_deg.to_radians().powi(2)], &axes);
        }
        if let Some(tilt) = sample.tilt {
            let expect = |s: &State| {
                let exact = convention.tilt_of(&(seen(s).inverse() * Vector3::z()));
                Some(DVector::from_column_slice(&[
                    wrap_angle(tilt.pitch - exact.pitch - zero.pitch - s.parameters[7]),
                    wrap_angle(tilt.roll - exact.roll - zero.roll - s.parameters[8]),
                ]))
            };
            let v = compass.tilt_noise_deg.to_radians().powi(2);
            self.update(&expect, &[v, v], &axes);
        }
    }

    /// A detected marker: the corners of a tag, or the centre of a disc.
    pub(super) fn marker(&mut self, seen: &MarkerDetection, marker: &MarkerConfig) {
        let k = match self.known.get(&seen.marker) {
            Some(k) => *k,
            None => match self.begin_marker(seen, marker) {
                Some(k) => k,
                None => return,
            },
        };
        let camera = self.rig.camera.intrinsics;
        let rig = self.rig;
        let half = 0.5 * marker.size_m.unwrap_or(0.0);
        let points: Vec<(Vector2<f64>, Vector3<f64>)> = match (marker.kind, seen.corners_px) {
            (MarkerKind::Apriltag, Some(corners)) => {
                let place = [(1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)];
                corners.into_iter().zip(place.map(|(f, r)| Vector3::new(f, r, 0.0) * half)).collect()
            }
            _ => vec![(seen.center_px, Vector3::zeros())],
        };
        let expect = |s: &State| {
            let eye = s.position + s.ned_from_body * s.lever();
            let camera_from_ned = (s.ned_from_body * s.body_from_camera(rig)).inverse();
            let m = s.markers[k];
            let mut out = Vec::with_capacity(2 * points.len());
            for (px, offset) in &points {
                let at = m.center + rot_z(m.top) * offset;
                let r = px - camera.project(&(camera_from_ned * (at - eye)))?.px;
                out.extend([r.x, r.y]);
            }
            Some(DVector::from_vec(out))
        };
        let variance = |c: f64| c + LEAST_PX * LEAST_PX;
        let noise: Vec<f64> = if points.len() == 4 {
            seen.corner_cov_px2.iter().flat_map(|c| [variance(c[(0, 0)]), variance(c[(1, 1)])]).collect()
        } else {
            vec![variance(seen.center_cov_px2[(0, 0)]), variance(seen.center_cov_px2[(1, 1)])]
        };
        let own = BASE + PER_MARKER * k;
        let axes: Vec<usize> =
            (0..3).chain(12..15).chain(FIRST..FIRST + 6).chain(own..own + PER_MARKER).collect();
        if self.update(&expect, &noise, &axes)
            && let Some(after) = expect(&self.state)
        {
            self.fit.0 += after.norm_squared();
            self.fit.1 += after.len();
        }
    }

    /// Places a marker by its size in the image. `None` where that is impossible.
    fn begin_marker(&mut self, seen: &MarkerDetection, marker: &MarkerConfig) -> Option<usize> {
        let size_m = marker.size_m.or(marker.diameter_m)?;
        let camera = &self.rig.camera.intrinsics;
        let m = camera.normalised(seen.center_px)?;
        let s = &self.state;
        let ned_from_camera = s.ned_from_body * s.body_from_camera(self.rig);
        let depth = camera.fx * size_m / seen.size_px;
        let eye = s.position + s.ned_from_body * s.lever();
        let center = eye + ned_from_camera * (Vector3::new(m.x, m.y, 1.0) * depth);
        let top = seen.corners_px.map_or(0.0, |c| {
            let up = (c[0] + c[1] - c[2] - c[3]) / 2.0;
            let along = ned_from_camera * Vector3::new(up.x, up.y, 0.0);
            along.y.atan2(along.x)
        });
        let k = s.markers.len();
        self.known.insert(seen.marker, k);
        self.state.markers.push(MarkerState { center, top });
        let old = self.covariance.nrows();
        self.covariance.resize_mut(old + PER_MARKER, old + PER_MARKER, 0.0);
        // Wide priors: all information comes from the pixels.
        for (axis, sigma) in [10.0, 10.0, 10.0, 0.7].into_iter().enumerate() {
            self.covariance[(old + axis, old + axis)] = f64::powi(sigma, 2);
        }
        Some(k)
    }

    /// Takes a surveyed position of a marker: NED, one-sigma.
    pub(super) fn surveyed(&mut self, id: MarkerId, at: Vector3<f64>, sigma_m: f64) {
        let Some(k) = self.known.get(&id).copied() else { return };
        let own = BASE + PER_MARKER * k;
        let expect = |s: &State| Some(DVector::from_column_slice((at - s.markers[k].center).as_slice()));
        self.update(&expect, &[sigma_m * sigma_m; 3], &[own, own + 1, own + 2]);
    }
}
