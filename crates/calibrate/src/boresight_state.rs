//! The state of a boresight: helicopter, mounting and markers, and small changes to it.

use nalgebra::{DVector, Rotation3, Vector3};
use windhover_base::geo::body_from_camera;
use windhover_base::settings::Rig;

/// Parameters of mounting and time, in the order of the state.
pub(super) const PARAMETERS: usize = 11;
/// Where they start in the state: after position, velocity, acceleration, GPS bias, attitude, rate.
pub(super) const FIRST: usize = 18;
/// States of each marker: its centre (north, east, down) and the direction of its top.
pub(super) const PER_MARKER: usize = 4;
pub(super) const BASE: usize = FIRST + PARAMETERS;
pub(super) const ATTITUDE: usize = 12;

/// Mounting and time: mount yaw, pitch, roll; lever arm forward, right, down; compass yaw, pitch and
/// roll zeros (reported minus true); lateness of compass and GPS stamps against the camera's.
pub(super) type Parameters = [f64; PARAMETERS];

/// The state at an instant.
#[derive(Clone, Debug)]
pub(super) struct State {
    pub(super) position: Vector3<f64>,
    pub(super) velocity: Vector3<f64>,
    pub(super) acceleration: Vector3<f64>,
    pub(super) bias: Vector3<f64>,
    pub(super) ned_from_body: Rotation3<f64>,
    pub(super) rate: Vector3<f64>,
    pub(super) parameters: Parameters,
    pub(super) markers: Vec<MarkerState>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct MarkerState {
    pub(super) center: Vector3<f64>,
    pub(super) top: f64,
}

impl State {
    /// The state changed by `amount` along one axis of its error.
    pub(super) fn moved(&self, axis: usize, amount: f64) -> Self {
        let mut next = self.clone();
        next.add(axis, amount);
        next
    }

    pub(super) fn add(&mut self, axis: usize, amount: f64) {
        match axis {
            0..3 => self.position[axis] += amount,
            3..6 => self.velocity[axis - 3] += amount,
            6..9 => self.acceleration[axis - 6] += amount,
            9..12 => self.bias[axis - 9] += amount,
            12..15 => {
                let mut turn = Vector3::zeros();
                turn[axis - ATTITUDE] = amount;
                self.ned_from_body = Rotation3::new(turn) * self.ned_from_body;
            }
            15..18 => self.rate[axis - 15] += amount,
            FIRST..BASE => self.parameters[axis - FIRST] += amount,
            _ => {
                let marker = &mut self.markers[(axis - BASE) / PER_MARKER];
                match (axis - BASE) % PER_MARKER {
                    3 => marker.top += amount,
                    part => marker.center[part] += amount,
                }
            }
        }
    }

    pub(super) fn size(&self) -> usize {
        BASE + PER_MARKER * self.markers.len()
    }

    /// Derivative of the state with respect to a rotation of everything about the vertical, per radian, without the
    /// constants.
    pub(super) fn turning(&self) -> DVector<f64> {
        let mut out = DVector::zeros(self.size());
        let mut put = |at: usize, v: &Vector3<f64>| {
            out[at] = -v.y;
            out[at + 1] = v.x;
        };
        put(0, &self.position);
        put(3, &self.velocity);
        put(6, &self.acceleration);
        for (k, marker) in self.markers.iter().enumerate() {
            put(BASE + PER_MARKER * k, &marker.center);
        }
        out
    }

    /// `body_from_camera` with the estimated mounting angles.
    pub(super) fn body_from_camera(&self, rig: &Rig) -> Rotation3<f64> {
        let [yaw, pitch, roll, ..] = self.parameters;
        body_from_camera(rig.camera.mount.image_top, yaw, pitch, roll)
    }

    pub(super) fn lever(&self) -> Vector3<f64> {
        Vector3::new(self.parameters[3], self.parameters[4], self.parameters[5])
    }
}
