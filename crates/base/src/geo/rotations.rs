//! Rotations, their Euler sequences, and the definitions of pitch and roll that compasses use.

use nalgebra::{Matrix3, Rotation3, Vector3};
use serde::{Deserialize, Serialize};

/// An angle wrapped into (−π, π].
///
/// ```
/// use std::f64::consts::PI;
/// assert!((windhover_base::geo::wrap_angle(1.5 * PI) + 0.5 * PI).abs() < 1e-12);
/// assert_eq!(windhover_base::geo::wrap_angle(-PI), PI);
/// ```
pub fn wrap_angle(angle: f64) -> f64 {
    let wrapped = angle.rem_euclid(std::f64::consts::TAU);
    if wrapped > std::f64::consts::PI { wrapped - std::f64::consts::TAU } else { wrapped }
}

/// Active rotation about x: `Rx = [1 0 0; 0 c −s; 0 s c]`.
pub fn rot_x(angle: f64) -> Rotation3<f64> {
    Rotation3::from_axis_angle(&Vector3::x_axis(), angle)
}

/// Active rotation about y: `Ry = [c 0 s; 0 1 0; −s 0 c]`.
pub fn rot_y(angle: f64) -> Rotation3<f64> {
    Rotation3::from_axis_angle(&Vector3::y_axis(), angle)
}

/// Active rotation about z: `Rz = [c −s 0; s c 0; 0 0 1]`.
///
/// ```
/// use windhover_base::geo::{rot_x, rot_y, rot_z};
/// use nalgebra::Vector3;
///
/// let quarter = std::f64::consts::FRAC_PI_2;
/// assert!((rot_z(quarter) * Vector3::x() - Vector3::y()).norm() < 1e-12);
/// assert!((rot_x(quarter) * Vector3::y() - Vector3::z()).norm() < 1e-12);
/// assert!((rot_y(quarter) * Vector3::z() - Vector3::x()).norm() < 1e-12);
/// ```
pub fn rot_z(angle: f64) -> Rotation3<f64> {
    Rotation3::from_axis_angle(&Vector3::z_axis(), angle)
}

/// The cross-product matrix: `skew(a) b = a × b`.
///
/// ```
/// use nalgebra::Vector3;
///
/// let (a, b) = (Vector3::new(1.0, 2.0, 3.0), Vector3::new(-1.0, 0.5, 2.0));
/// assert_eq!(windhover_base::geo::skew(&a) * b, a.cross(&b));
/// ```
pub fn skew(a: &Vector3<f64>) -> Matrix3<f64> {
    a.cross_matrix()
}

/// Aircraft sequence 3-2-1: `ned_from_body = Rz(heading) Ry(pitch) Rx(roll)`.
///
/// ```
/// use windhover_base::geo::{euler_321, ned_from_body_321};
/// use nalgebra::Vector3;
///
/// // Heading east, nose up 10°: the nose points east and up.
/// let ned_from_body = ned_from_body_321(90_f64.to_radians(), 10_f64.to_radians(), 0.0);
/// let nose = ned_from_body * Vector3::x();
/// assert!(nose.y > 0.98 && nose.z < -0.17);
/// let (heading, pitch, roll) = euler_321(&ned_from_body);
/// assert!((heading.to_degrees() - 90.0).abs() < 1e-9 && (pitch.to_degrees() - 10.0).abs() < 1e-9 && roll.abs() < 1e-9);
/// ```
pub fn ned_from_body_321(heading: f64, pitch: f64, roll: f64) -> Rotation3<f64> {
    rot_z(heading) * rot_y(pitch) * rot_x(roll)
}

/// The paper's sequence 3-1-2: `ned_from_body = Rz(ψ) Rx(φ) Ry(θ)` (paper eq. 14–18, corrected).
///
/// ```
/// use windhover_base::geo::{euler_312, ned_from_body_312};
///
/// let (psi, phi, theta) = euler_312(&ned_from_body_312(0.3, -0.1, 0.2));
/// assert!((psi - 0.3).abs() < 1e-12 && (phi + 0.1).abs() < 1e-12 && (theta - 0.2).abs() < 1e-12);
/// ```
pub fn ned_from_body_312(psi: f64, phi: f64, theta: f64) -> Rotation3<f64> {
    rot_z(psi) * rot_x(phi) * rot_y(theta)
}

/// (heading, pitch, roll) of the sequence 3-2-1.
pub fn euler_321(ned_from_body: &Rotation3<f64>) -> (f64, f64, f64) {
    let r = ned_from_body.matrix();
    let pitch = (-r[(2, 0)]).clamp(-1.0, 1.0).asin();
    (r[(1, 0)].atan2(r[(0, 0)]), pitch, r[(2, 1)].atan2(r[(2, 2)]))
}

/// (ψ, φ, θ) of the paper's sequence 3-1-2.
pub fn euler_312(ned_from_body: &Rotation3<f64>) -> (f64, f64, f64) {
    let r = ned_from_body.matrix();
    let phi = r[(2, 1)].clamp(-1.0, 1.0).asin();
    ((-r[(0, 1)]).atan2(r[(1, 1)]), phi, (-r[(2, 0)]).atan2(r[(2, 2)]))
}

/// A compass's definition of pitch and roll; `g` is the down unit vector in the body.
///
/// ```
/// use windhover_base::geo::{Tilt, TiltConvention};
///
/// // One attitude, as compasses of two conventions report it.
/// let tilt = Tilt { pitch: 0.4, roll: 0.5 };
/// let down = TiltConvention::Euler321.down_in_body(tilt).expect("there is such an attitude");
/// let other = TiltConvention::Elevation.tilt_of(&down);
/// assert!((other.pitch - 0.4).abs() < 1e-12 && other.roll < 0.47);
/// // No body has both axes 60° above the horizon.
/// let steep = Tilt { pitch: 60_f64.to_radians(), roll: 60_f64.to_radians() };
/// assert_eq!(TiltConvention::Elevation.down_in_body(steep), None);
/// ```
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TiltConvention {
    /// Aircraft angles: pitch = asin(−g1), roll = atan2(g2, g3).
    #[default]
    Euler321,
    /// The paper's angles: pitch = atan2(−g1, g3), roll = asin(g2).
    Euler312,
    /// Elevation of each axis over the level plane: pitch = asin(−g1), roll = asin(g2).
    Elevation,
    /// Projected: pitch = atan(−g1/g3), roll = atan(g2/g3).
    Projection,
}

/// Pitch and roll as a compass with some [`TiltConvention`] reports them, radians.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Tilt {
    /// Nose up positive.
    pub pitch: f64,
    /// Right side down positive.
    pub roll: f64,
}

impl TiltConvention {
    /// The down unit vector in the body frame; `None` where no attitude has these angles.
    pub fn down_in_body(self, tilt: Tilt) -> Option<Vector3<f64>> {
        let (sp, cp) = tilt.pitch.sin_cos();
        let (sr, cr) = tilt.roll.sin_cos();
        let down = match self {
            Self::Euler321 => Vector3::new(-sp, cp * sr, cp * cr),
            Self::Euler312 => Vector3::new(-cr * sp, sr, cr * cp),
            Self::Elevation => {
                let rest = 1.0 - sp * sp - sr * sr;
                if rest < 0.0 {
                    return None;
                }
                Vector3::new(-sp, sr, rest.sqrt())
            }
            Self::Projection => {
                if cp <= 1e-6 || cr <= 1e-6 {
                    return None;
                }
                Vector3::new(-sp / cp, sr / cr, 1.0).normalize()
            }
        };
        down.iter().all(|x| x.is_finite()).then_some(down)
    }

    /// The angles a compass of this convention reports for a down vector in the body frame.
    pub fn tilt_of(self, down: &Vector3<f64>) -> Tilt {
        let g = down.normalize();
        let asin = |x: f64| x.clamp(-1.0, 1.0).asin();
        match self {
            Self::Euler321 => Tilt { pitch: asin(-g.x), roll: g.y.atan2(g.z) },
            Self::Euler312 => Tilt { pitch: (-g.x).atan2(g.z), roll: asin(g.y) },
            Self::Elevation => Tilt { pitch: asin(-g.x), roll: asin(g.y) },
            Self::Projection => Tilt { pitch: (-g.x / g.z).atan(), roll: (g.y / g.z).atan() },
        }
    }

    /// Attitude from a tilt-compensated compass: heading is the azimuth of the board's x axis.
    pub fn ned_from_body(self, heading: f64, tilt: Tilt) -> Option<Rotation3<f64>> {
        let (pitch, roll) = tilt_from_down(&self.down_in_body(tilt)?);
        Some(ned_from_body_321(heading, pitch, roll))
    }
}

/// (pitch, roll) of the sequence 3-2-1 from a down vector in the body frame.
///
/// ```
/// use nalgebra::Vector3;
///
/// let (pitch, roll) = windhover_base::geo::tilt_from_down(&Vector3::new(0.0, 1.0, 1.0));
/// assert!(pitch == 0.0 && (roll.to_degrees() - 45.0).abs() < 1e-9);
/// ```
pub fn tilt_from_down(down: &Vector3<f64>) -> (f64, f64) {
    let g = down.normalize();
    ((-g.x).clamp(-1.0, 1.0).asin(), g.y.atan2(g.z))
}

/// The direction on the aircraft to which the top of the image points.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ImageTop {
    /// Toward the nose.
    #[default]
    Forward,
    /// Toward the right side.
    Right,
    /// Toward the tail.
    Aft,
    /// Toward the left side.
    Left,
}

impl ImageTop {
    /// `body_from_camera` of a camera that looks straight down, before small mounting angles.
    pub fn base(self) -> Rotation3<f64> {
        let quarter_turns = match self {
            Self::Forward => 0.0,
            Self::Right => 1.0,
            Self::Aft => 2.0,
            Self::Left => 3.0,
        };
        // Forward: image right is starboard and image down is aft, [0 −1 0; 1 0 0; 0 0 1].
        rot_z((1.0 + quarter_turns) * std::f64::consts::FRAC_PI_2)
    }
}

/// `body_from_camera = Rz(yaw) Ry(pitch) Rx(roll) · base(image_top)`, small mounting angles in radians.
///
/// ```
/// use windhover_base::geo::{ImageTop, body_from_camera};
/// use nalgebra::Vector3;
///
/// // The top of the image (−v) points to the nose, the optical axis down.
/// let body_from_camera = body_from_camera(ImageTop::Forward, 0.0, 0.0, 0.0);
/// assert!((body_from_camera * -Vector3::y() - Vector3::x()).norm() < 1e-12);
/// assert!((body_from_camera * Vector3::z() - Vector3::z()).norm() < 1e-12);
/// ```
pub fn body_from_camera(image_top: ImageTop, yaw: f64, pitch: f64, roll: f64) -> Rotation3<f64> {
    ned_from_body_321(yaw, pitch, roll) * image_top.base()
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONVENTIONS: [TiltConvention; 4] = [
        TiltConvention::Euler321,
        TiltConvention::Euler312,
        TiltConvention::Elevation,
        TiltConvention::Projection,
    ];

    #[test]
    fn paper_matrix_as_corrected() {
        let (psi, phi, theta) = (0.4, -0.2, 0.3);
        let r = ned_from_body_312(psi, phi, theta);
        let (sp, cp) = f64::sin_cos(psi);
        let (sf, cf) = f64::sin_cos(phi);
        let (st, ct) = f64::sin_cos(theta);
        let want = Matrix3::new(
            ct * cp - sf * sp * st,
            -sp * cf,
            cp * st + sf * sp * ct,
            sp * ct + sf * cp * st,
            cf * cp,
            sp * st - sf * cp * ct,
            -st * cf,
            sf,
            cf * ct,
        );
        assert!((r.matrix() - want).norm() < 1e-12);
        let back = euler_312(&r);
        assert!((back.0 - psi).abs() + (back.1 - phi).abs() + (back.2 - theta).abs() < 1e-12);
    }

    #[test]
    fn signs_are_nose_east_nose_up_right_down() {
        let yawed = ned_from_body_321(0.1, 0.0, 0.0) * Vector3::x();
        assert!(yawed.y > 0.0, "nose to the east");
        let pitched = ned_from_body_321(0.0, 0.1, 0.0) * Vector3::x();
        assert!(pitched.z < 0.0, "nose up");
        let rolled = ned_from_body_321(0.0, 0.0, 0.1) * Vector3::y();
        assert!(rolled.z > 0.0, "right side down");
    }

    #[test]
    fn every_tilt_convention_goes_there_and_back() {
        for convention in CONVENTIONS {
            for (pitch, roll) in [(0.0, 0.0), (0.2, -0.1), (-0.5, 0.4)] {
                let attitude = ned_from_body_321(1.1, pitch, roll);
                let down = attitude.inverse() * Vector3::z();
                let reported = convention.tilt_of(&down);
                let back = convention.ned_from_body(1.1, reported).expect("a real attitude");
                assert!((back.matrix() - attitude.matrix()).norm() < 1e-12, "{convention:?}");
            }
        }
    }

    #[test]
    fn impossible_elevations_are_refused() {
        let tilt = Tilt { pitch: 1.2, roll: 1.2 };
        assert!(TiltConvention::Elevation.down_in_body(tilt).is_none());
    }

    #[test]
    fn belly_camera_image_right_is_starboard() {
        let r = ImageTop::Forward.base();
        assert!((r * Vector3::x() - Vector3::y()).norm() < 1e-12);
        assert!((r * Vector3::y() + Vector3::x()).norm() < 1e-12);
        let right = ImageTop::Right.base() * -Vector3::y();
        assert!((right - Vector3::y()).norm() < 1e-12, "image top (−v) points right");
    }
}
