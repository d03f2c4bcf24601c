//! States and covariances from north-east-down and forward-right-down to REP-103's east-north-up and forward-left-up.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Matrix3, Matrix6, SMatrix, UnitQuaternion, Vector3};

use super::{BASE_LINK, MAP, NOT_ESTIMATED, RosTranslator};
use crate::io::proto::host_time;
use crate::io::proto::windhover::{Ownship, TargetState, TrackStatus};
use crate::io::ros::{Header, Imu, NavSatFix, Odometry, RosRecord, TfMessage, Transform};
use windhover_base::geo::{Geodetic, skew};
use windhover_base::time::MonoTime;

/// Converts forward-right-down to forward-left-up, and back.
pub(super) fn flu(frd: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(frd.x, -frd.y, -frd.z)
}

/// Half a turn about the forward axis.
pub(super) fn flu_from_frd() -> UnitQuaternion<f64> {
    UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(0.0, 1.0, 0.0, 0.0))
}

/// Half a turn about the line between north and east.
fn enu_from_ned() -> UnitQuaternion<f64> {
    let half = std::f64::consts::FRAC_1_SQRT_2;
    UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(0.0, half, half, 0.0))
}

/// Row by row; the matrices are stored by columns and are symmetric.
fn rows<const N: usize, const M: usize>(p: &SMatrix<f64, N, N>) -> [f64; M] {
    std::array::from_fn(|k| p[(k / N, k % N)])
}

/// The symmetric matrix of an upper triangle given row by row; `None` for another number of terms, and for terms that
/// are not finite.
fn symmetric<const N: usize>(upper: &[f64]) -> Option<SMatrix<f64, N, N>> {
    if upper.len() != N * (N + 1) / 2 || !upper.iter().all(|term| term.is_finite()) {
        return None;
    }
    let mut terms = upper.iter();
    let mut p = SMatrix::zeros();
    for i in 0..N {
        for j in i..N {
            p[(i, j)] = *terms.next()?;
            p[(j, i)] = p[(i, j)];
        }
    }
    Some(p)
}

/// A covariance in which nothing is estimated.
fn nothing_known() -> Matrix6<f64> {
    Matrix6::identity() * NOT_ESTIMATED
}

/// Sets a covariance and its mirror.
fn set(p: &mut Matrix6<f64>, (i, j): (usize, usize), value: f64) {
    // Adding zero removes the sign of −0 from files.
    (p[(i, j)], p[(j, i)]) = (value + 0.0, value + 0.0);
}

/// Yaw counts from east counter-clockwise, heading from north clockwise: yaw = π/2 − heading, their rates are opposite.
/// Pose and twist covariances of the state (north, east, heading, speed, yaw rate): only signs change.
fn target_covariances(p: &SMatrix<f64, 5, 5>) -> (Matrix6<f64>, Matrix6<f64>) {
    let (mut pose, mut twist) = (nothing_known(), nothing_known());
    set(&mut pose, (0, 0), p[(1, 1)]);
    set(&mut pose, (0, 1), p[(0, 1)]);
    set(&mut pose, (1, 1), p[(0, 0)]);
    set(&mut pose, (0, 5), -p[(1, 2)]);
    set(&mut pose, (1, 5), -p[(0, 2)]);
    set(&mut pose, (5, 5), p[(2, 2)]);
    set(&mut twist, (0, 0), p[(3, 3)]);
    set(&mut twist, (0, 5), -p[(3, 4)]);
    set(&mut twist, (5, 5), p[(4, 4)]);
    (pose, twist)
}

/// Pose covariance of the helicopter's (north, east, down; velocity; rotations about north, east, down): the same
/// values in another order, with down changed to up.
fn ownship_pose(p: &SMatrix<f64, 9, 9>) -> Matrix6<f64> {
    const FROM: [(usize, f64); 6] = [(1, 1.0), (0, 1.0), (2, -1.0), (7, 1.0), (6, 1.0), (8, -1.0)];
    Matrix6::from_fn(|i, j| FROM[i].1 * FROM[j].1 * p[(FROM[i].0, FROM[j].0)] + 0.0)
}

/// Covariance of the velocity in body axes, v_b = Rᵀ v with R = ned_from_body turned by small θ:
/// δv_b = Rᵀ (δv + v × θ).
fn ownship_twist(
    p: &SMatrix<f64, 9, 9>,
    velocity_ned: &Vector3<f64>,
    flu_from_ned: &Matrix3<f64>,
) -> Matrix6<f64> {
    let by_rotation = flu_from_ned * skew(velocity_ned);
    let (velocity, rotation) = (p.fixed_view::<3, 3>(3, 3), p.fixed_view::<3, 3>(6, 6));
    let mixed = flu_from_ned * p.fixed_view::<3, 3>(3, 6) * by_rotation.transpose();
    let linear = flu_from_ned * velocity * flu_from_ned.transpose()
        + mixed
        + mixed.transpose()
        + by_rotation * rotation * by_rotation.transpose();
    let mut twist = nothing_known();
    twist.fixed_view_mut::<3, 3>(0, 0).copy_from(&((linear + linear.transpose()) * 0.5));
    twist
}

/// Flights of earlier versions have sigmas only.
fn ownship_covariance(own: &Ownship) -> Option<SMatrix<f64, 9, 9>> {
    symmetric(&own.covariance).or_else(|| {
        let (position, attitude) = (&own.position_sigma_m, &own.attitude_sigma_rad);
        if (position.len(), attitude.len()) != (3, 3) {
            return None;
        }
        let mut p = SMatrix::zeros();
        for axis in 0..3 {
            p[(axis, axis)] = position[axis].powi(2);
            p[(axis + 3, axis + 3)] = NOT_ESTIMATED;
            p[(axis + 6, axis + 6)] = attitude[axis].powi(2);
        }
        Some(p)
    })
}

impl RosTranslator {
    /// The helicopter's place and motion, and whether its covariance is known.
    fn ownship_odometry(&self, own: &Ownship) -> Option<(Odometry, bool)> {
        let ned_from_body = nalgebra::Quaternion::new(own.qw, own.qx, own.qy, own.qz);
        let ned_from_body = UnitQuaternion::try_new(ned_from_body, 1e-6).filter(|_| own.is_sound())?;
        let velocity = Vector3::new(own.vn_mps, own.ve_mps, own.vd_mps);
        let flu_from_ned = flu_from_frd() * ned_from_body.inverse();
        let p = ownship_covariance(own);
        let pose = p.as_ref().map_or_else(nothing_known, ownship_pose);
        let matrix = flu_from_ned.to_rotation_matrix();
        let twist = p.as_ref().map_or_else(nothing_known, |p| ownship_twist(p, &velocity, matrix.matrix()));
        let odometry = Odometry {
            header: Header::new(host_time(own.timestamp.as_ref()), self.frame(MAP)),
            child_frame_id: self.frame(BASE_LINK),
            position: Vector3::new(own.east_m, own.north_m, -own.down_m),
            orientation: enu_from_ned() * ned_from_body * flu_from_frd(),
            pose_covariance: rows(&pose),
            linear: flu_from_ned * velocity,
            angular: Vector3::zeros(),
            twist_covariance: rows(&twist),
        };
        Some((odometry, p.is_some()))
    }

    /// `/ownship/odometry`, `/ownship/imu` (attitude alone), `/ownship/fix`, `/tf`.
    pub(super) fn ownship(&mut self, own: &Ownship, log: MonoTime, out: &mut Vec<RosRecord>) {
        let Some((odometry, is_known)) = self.ownship_odometry(own) else { return };
        let (t, position, orientation) = (odometry.header.stamp, odometry.position, odometry.orientation);
        let pose = Matrix6::from_row_slice(&odometry.pose_covariance);
        out.push(RosRecord::new(self.topic("/ownship/odometry"), log, t, &odometry));
        let mut absent = [0.0; 9];
        absent[0] = -1.0;
        let imu = Imu {
            header: Header::new(t, self.frame(BASE_LINK)),
            orientation,
            orientation_covariance: rows(&pose.fixed_view::<3, 3>(3, 3).into_owned()),
            angular_velocity: Vector3::zeros(),
            angular_velocity_covariance: absent,
            linear_acceleration: Vector3::zeros(),
            linear_acceleration_covariance: absent,
        };
        out.push(RosRecord::new(self.topic("/ownship/imu"), log, t, &imu));
        let fix = NavSatFix {
            header: Header::new(t, self.frame(BASE_LINK)),
            status: 0,
            latitude: own.lat_deg,
            longitude: own.lon_deg,
            altitude: own.height_m,
            position_covariance: rows(&pose.fixed_view::<3, 3>(0, 0).into_owned()),
            position_covariance_type: if is_known { 3 } else { 0 },
        };
        out.push(RosRecord::new(self.topic("/ownship/fix"), log, t, &fix));
        self.transform(t, log, &self.frame(BASE_LINK), position, orientation, out);
    }

    /// `/ownship/odometry_refined`: the refined estimate.
    pub(super) fn ownship_refined(&self, own: &Ownship, log: MonoTime, out: &mut Vec<RosRecord>) {
        if let Some((odometry, _)) = self.ownship_odometry(own) {
            out.push(RosRecord::new(
                self.topic("/ownship/odometry_refined"),
                log,
                odometry.header.stamp,
                &odometry,
            ));
        }
    }

    /// `/target/NAME/odometry`, `…/fix`, `/tf` of the real-time state; of later estimates the odometry alone, under its
    /// own name.
    pub(super) fn target(&mut self, s: &TargetState, later: &str, log: MonoTime, out: &mut Vec<RosRecord>) {
        if !s.known || !s.is_sound() || s.status() == TrackStatus::Lost {
            return;
        }
        let Some(name) = self.names.of(&s.target) else { return };
        let frame = self.frame(&format!("{name}/base_link"));
        let t = host_time(s.timestamp.as_ref());
        let place = Geodetic { lat_deg: s.lat_deg, lon_deg: s.lon_deg, height_m: s.height_m };
        let up = self.datum.as_ref().map_or(0.0, |datum| -datum.ned(place).z);
        let position = Vector3::new(s.east_m, s.north_m, up);
        let orientation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2 - s.heading_rad);
        let p = symmetric(&s.covariance);
        let (pose, twist) = p.as_ref().map_or_else(|| (nothing_known(), nothing_known()), target_covariances);
        let turn = -s.yaw_rate_radps;
        let ahead = self.references_m.get(&s.target).copied().unwrap_or(0.0);
        let odometry = Odometry {
            header: Header::new(t, self.frame(MAP)),
            child_frame_id: frame.clone(),
            position,
            orientation,
            pose_covariance: rows(&pose),
            linear: Vector3::new(s.speed_mps, turn * ahead + 0.0, 0.0),
            angular: Vector3::new(0.0, 0.0, turn),
            twist_covariance: rows(&twist),
        };
        out.push(RosRecord::new(self.topic(&format!("/target/{name}/odometry{later}")), log, t, &odometry));
        if !later.is_empty() {
            return;
        }
        let fix = NavSatFix {
            header: Header::new(t, frame.clone()),
            status: 0,
            latitude: s.lat_deg,
            longitude: s.lon_deg,
            altitude: s.height_m,
            position_covariance: rows(&pose.fixed_view::<3, 3>(0, 0).into_owned()),
            position_covariance_type: u8::from(p.is_some()),
        };
        out.push(RosRecord::new(self.topic(&format!("/target/{name}/fix")), log, t, &fix));
        self.transform(t, log, &frame, position, orientation, out);
    }

    /// `/tf`: a frame in the map.
    fn transform(
        &self,
        t: MonoTime,
        log: MonoTime,
        child: &str,
        translation: Vector3<f64>,
        rotation: UnitQuaternion<f64>,
        out: &mut Vec<RosRecord>,
    ) {
        let transform = Transform {
            header: Header::new(t, self.frame(MAP)),
            child_frame_id: child.into(),
            translation,
            rotation,
        };
        out.push(RosRecord::new("/tf", log, t, &TfMessage(vec![transform])));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    #[test]
    fn the_turns_between_axes_are_what_they_say() {
        let enu = enu_from_ned() * Vector3::new(1.0, 2.0, 3.0);
        assert!((enu - Vector3::new(2.0, 1.0, -3.0)).norm() < 1e-15, "{enu}");
        let frd = Vector3::new(1.0, 2.0, 3.0);
        assert!((flu_from_frd() * frd - flu(&frd)).norm() < 1e-15);
        // Nose to the east, level: no turn in REP-103.
        let ned_from_body = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2);
        let level = enu_from_ned() * ned_from_body * flu_from_frd();
        assert!(level.angle() < 1e-7, "{level}");
    }

    /// The covariance of body velocity against finite differences: each of the nine states is varied by a little.
    #[test]
    fn the_twist_takes_the_attitudes_error_along() {
        let v = Vector3::new(4.0, -3.0, 1.0);
        let ned_from_body = Rotation3::from_euler_angles(0.1, -0.2, 1.1);
        let flu_from =
            |ned_from_body: &Rotation3<f64>| flu_from_frd().to_rotation_matrix() * ned_from_body.inverse();
        let mut p = SMatrix::<f64, 9, 9>::identity();
        (p[(3, 7)], p[(7, 3)]) = (0.4, 0.4);
        let step = 1e-6;
        let body = |k: usize, by: f64| {
            let (mut v, mut theta) = (v, Vector3::zeros());
            match k {
                3..6 => v[k - 3] += by,
                6.. => theta[k - 6] += by,
                _ => {}
            }
            flu_from(&(Rotation3::new(theta) * ned_from_body)) * v
        };
        let jacobian =
            SMatrix::<f64, 3, 9>::from_fn(|row, k| (body(k, step) - body(k, -step))[row] / (2.0 * step));
        let expected = jacobian * p * jacobian.transpose();
        let twist = ownship_twist(&p, &v, flu_from(&ned_from_body).matrix());
        assert!((twist.fixed_view::<3, 3>(0, 0) - expected).norm() < 1e-6, "{twist} {expected}");
    }

    #[test]
    fn covariances_change_places_and_signs_only() {
        let upper: Vec<f64> = (1..=15).map(f64::from).collect();
        let p = symmetric::<5>(&upper).expect("fifteen terms");
        let (pose, twist) = target_covariances(&p);
        // nn 1, ne 2, nh 3, nv 4, nw 5, ee 6, eh 7, …, hh 10, …, vv 13, vw 14, ww 15.
        assert_eq!((pose[(0, 0)], pose[(0, 1)], pose[(1, 1)]), (6.0, 2.0, 1.0));
        assert_eq!((pose[(0, 5)], pose[(5, 1)], pose[(5, 5)]), (-7.0, -3.0, 10.0));
        assert_eq!((twist[(0, 0)], twist[(0, 5)], twist[(5, 5)]), (13.0, -14.0, 15.0));
        assert_eq!(pose[(2, 2)], NOT_ESTIMATED);
        assert!(symmetric::<5>(&upper[1..]).is_none());
    }
}
