//! Messages of ROS 2 as values, and their CDR. Fields have ROS's names, units and frames (REP-103); only fields that
//! are set are here, the others are written with their defaults.

use nalgebra::{UnitQuaternion, Vector3};

use super::RosType;
use super::cdr::CdrWriter;
use windhover_base::time::{MonoTime, NS_PER_S};

/// A message that can be serialised.
pub trait RosMessage {
    /// Its type.
    const TYPE: RosType;

    #[doc(hidden)]
    fn write(&self, cdr: &mut CdrBody<'_>);

    /// The message in CDR, with its encapsulation header.
    fn to_cdr(&self) -> Vec<u8> {
        let mut cdr = CdrWriter::new();
        self.write(&mut CdrBody(&mut cdr));
        cdr.finish()
    }
}

/// The body of a message being serialised.
pub struct CdrBody<'a>(&'a mut CdrWriter);

impl CdrBody<'_> {
    /// Seconds beyond ROS's 32 bits (after 2038) become the largest that fits.
    fn time(&mut self, t: MonoTime) {
        let seconds = t.ns().div_euclid(NS_PER_S);
        self.0.i32(i32::try_from(seconds).unwrap_or(if seconds < 0 { i32::MIN } else { i32::MAX }));
        self.0.u32(t.ns().rem_euclid(NS_PER_S) as u32);
    }

    fn header(&mut self, header: &Header) {
        self.time(header.stamp);
        self.0.string(&header.frame_id);
    }

    fn vector(&mut self, v: &Vector3<f64>) {
        self.0.f64s(v.as_slice());
    }

    fn quaternion(&mut self, q: &UnitQuaternion<f64>) {
        self.0.f64s(&[q.i, q.j, q.k, q.w]);
    }
}

/// `std_msgs/Header`
#[derive(Clone, PartialEq, Debug)]
pub struct Header {
    /// Time of validity, host time.
    pub stamp: MonoTime,
    /// Frame of the values.
    pub frame_id: String,
}

impl Header {
    /// A header of this instant, in this frame.
    pub fn new(stamp: MonoTime, frame_id: impl Into<String>) -> Self {
        Self { stamp, frame_id: frame_id.into() }
    }
}

/// `nav_msgs/Odometry`
#[derive(Clone, PartialEq, Debug)]
pub struct Odometry {
    /// Stamp, and frame of the pose.
    pub header: Header,
    /// Frame of the twist.
    pub child_frame_id: String,
    /// Position, metres.
    pub position: Vector3<f64>,
    /// `header.frame_id` from `child_frame_id`.
    pub orientation: UnitQuaternion<f64>,
    /// Of (x, y, z, rotations about the axes of `header.frame_id`), row by row.
    pub pose_covariance: [f64; 36],
    /// m/s, in the child frame.
    pub linear: Vector3<f64>,
    /// rad/s, in the child frame.
    pub angular: Vector3<f64>,
    /// Of (linear, angular), row by row.
    pub twist_covariance: [f64; 36],
}

impl RosMessage for Odometry {
    const TYPE: RosType = RosType::Odometry;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.header(&self.header);
        cdr.0.string(&self.child_frame_id);
        cdr.vector(&self.position);
        cdr.quaternion(&self.orientation);
        cdr.0.f64s(&self.pose_covariance);
        cdr.vector(&self.linear);
        cdr.vector(&self.angular);
        cdr.0.f64s(&self.twist_covariance);
    }
}

/// `sensor_msgs/NavSatFix`
#[derive(Clone, PartialEq, Debug)]
pub struct NavSatFix {
    /// Stamp, and frame of the antenna.
    pub header: Header,
    /// −1 no fix, 0 a fix, 2 a fix with carrier phases.
    pub status: i8,
    /// Degrees; NaN where not known.
    pub latitude: f64,
    /// Degrees.
    pub longitude: f64,
    /// Above the ellipsoid, metres; NaN where not known.
    pub altitude: f64,
    /// Of (east, north, up), row by row.
    pub position_covariance: [f64; 9],
    /// 0 unknown, 1 approximated, 2 its diagonal known, 3 known.
    pub position_covariance_type: u8,
}

impl RosMessage for NavSatFix {
    const TYPE: RosType = RosType::NavSatFix;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        /// `NavSatStatus::SERVICE_GPS`: whether other systems took part is not known.
        const SERVICE_GPS: u16 = 1;
        cdr.header(&self.header);
        cdr.0.i8(self.status);
        cdr.0.u16(SERVICE_GPS);
        cdr.0.f64s(&[self.latitude, self.longitude, self.altitude]);
        cdr.0.f64s(&self.position_covariance);
        cdr.0.u8(self.position_covariance_type);
    }
}

/// `sensor_msgs/Imu`; the first term of a covariance is −1 where the values are absent.
#[derive(Clone, PartialEq, Debug)]
pub struct Imu {
    /// Stamp, and the sensor's frame.
    pub header: Header,
    /// World from sensor.
    pub orientation: UnitQuaternion<f64>,
    /// About the axes of the world.
    pub orientation_covariance: [f64; 9],
    /// rad/s.
    pub angular_velocity: Vector3<f64>,
    /// About the sensor's axes.
    pub angular_velocity_covariance: [f64; 9],
    /// Specific force, m/s².
    pub linear_acceleration: Vector3<f64>,
    /// Along the sensor's axes.
    pub linear_acceleration_covariance: [f64; 9],
}

impl RosMessage for Imu {
    const TYPE: RosType = RosType::Imu;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.header(&self.header);
        cdr.quaternion(&self.orientation);
        cdr.0.f64s(&self.orientation_covariance);
        cdr.vector(&self.angular_velocity);
        cdr.0.f64s(&self.angular_velocity_covariance);
        cdr.vector(&self.linear_acceleration);
        cdr.0.f64s(&self.linear_acceleration_covariance);
    }
}

/// `sensor_msgs/CompressedImage`
#[derive(Clone, PartialEq, Debug)]
pub struct CompressedImage<'a> {
    /// Stamp, and the camera's frame.
    pub header: Header,
    /// `jpeg`, `png`.
    pub format: &'static str,
    /// The image.
    pub data: &'a [u8],
}

impl RosMessage for CompressedImage<'_> {
    const TYPE: RosType = RosType::CompressedImage;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.header(&self.header);
        cdr.0.string(self.format);
        cdr.0.bytes(self.data);
    }
}

/// `sensor_msgs/Image`
#[derive(Clone, PartialEq, Debug)]
pub struct Image<'a> {
    /// Stamp, and the camera's frame.
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// As `sensor_msgs/image_encodings.hpp` names it.
    pub encoding: &'static str,
    /// Bytes a row.
    pub step: u32,
    /// The rows.
    pub data: &'a [u8],
}

impl RosMessage for Image<'_> {
    const TYPE: RosType = RosType::Image;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.header(&self.header);
        cdr.0.u32(self.height);
        cdr.0.u32(self.width);
        cdr.0.string(self.encoding);
        cdr.0.u8(0);
        cdr.0.u32(self.step);
        cdr.0.bytes(self.data);
    }
}

/// `sensor_msgs/CameraInfo`
#[derive(Clone, PartialEq, Debug)]
pub struct CameraInfo {
    /// Stamp of the image, and the camera's frame.
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// `plumb_bob`, `equidistant`.
    pub distortion_model: String,
    /// Its terms.
    pub d: Vec<f64>,
    /// Intrinsics, row by row; the centre of the top-left pixel is (0, 0).
    pub k: [f64; 9],
    /// Projection of the rectified image, row by row.
    pub p: [f64; 12],
}

impl RosMessage for CameraInfo {
    const TYPE: RosType = RosType::CameraInfo;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.header(&self.header);
        cdr.0.u32(self.height);
        cdr.0.u32(self.width);
        cdr.0.string(&self.distortion_model);
        cdr.0.length(self.d.len());
        cdr.0.f64s(&self.d);
        cdr.0.f64s(&self.k);
        // One camera: no rotation for rectification.
        cdr.0.f64s(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        cdr.0.f64s(&self.p);
        // No binning, the whole image.
        (0..6).for_each(|_| cdr.0.u32(0));
        cdr.0.u8(0);
    }
}

/// `geometry_msgs/TransformStamped`
#[derive(Clone, PartialEq, Debug)]
pub struct Transform {
    /// Stamp, and the parent.
    pub header: Header,
    /// The child.
    pub child_frame_id: String,
    /// Of the child's origin, in the parent.
    pub translation: Vector3<f64>,
    /// Parent from child.
    pub rotation: UnitQuaternion<f64>,
}

/// `tf2_msgs/TFMessage`
#[derive(Clone, PartialEq, Debug)]
pub struct TfMessage(pub Vec<Transform>);

impl RosMessage for TfMessage {
    const TYPE: RosType = RosType::TfMessage;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.0.length(self.0.len());
        for transform in &self.0 {
            cdr.header(&transform.header);
            cdr.0.string(&transform.child_frame_id);
            cdr.vector(&transform.translation);
            cdr.quaternion(&transform.rotation);
        }
    }
}

/// `apriltag_msgs/AprilTagDetection`
#[derive(Clone, PartialEq, Debug)]
pub struct AprilTag {
    /// As the AprilTag library names it.
    pub family: String,
    /// Identity.
    pub id: i32,
    /// Wrong bits corrected.
    pub hamming: i32,
    /// Contrast at the weakest decision, grey levels.
    pub decision_margin: f32,
    /// Pixels.
    pub centre: [f64; 2],
    /// Pixels, in the order of the AprilTag library: bottom left, bottom right, top right, top left.
    pub corners: [[f64; 2]; 4],
}

/// `apriltag_msgs/AprilTagDetectionArray`
#[derive(Clone, PartialEq, Debug)]
pub struct AprilTagDetectionArray {
    /// Stamp of the image, and the camera's frame.
    pub header: Header,
    /// The detections.
    pub detections: Vec<AprilTag>,
}

impl RosMessage for AprilTagDetectionArray {
    const TYPE: RosType = RosType::AprilTagDetectionArray;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.header(&self.header);
        cdr.0.length(self.detections.len());
        for tag in &self.detections {
            cdr.0.string(&tag.family);
            cdr.0.i32(tag.id);
            cdr.0.i32(tag.hamming);
            // Goodness, which the library no longer provides.
            cdr.0.f32(0.0);
            cdr.0.f32(tag.decision_margin);
            cdr.0.f64s(&tag.centre);
            tag.corners.iter().for_each(|corner| cdr.0.f64s(corner));
            cdr.0.f64s(&homography(&tag.corners));
        }
    }
}

/// The homography, row by row, that maps the square of corners (−1, 1), (1, 1), (1, −1), (−1, −1), in this order, to
/// four pixels; zeros where three of them are on a line (Heckbert 1989, §2.2.3, with its unit square mapped to this
/// one).
fn homography(corners: &[[f64; 2]; 4]) -> [f64; 9] {
    let [p3, p2, p1, p0] = *corners;
    let (d1, d2) = ([p1[0] - p2[0], p1[1] - p2[1]], [p3[0] - p2[0], p3[1] - p2[1]]);
    let sum = [p0[0] - p1[0] + p2[0] - p3[0], p0[1] - p1[1] + p2[1] - p3[1]];
    let det = d1[0] * d2[1] - d2[0] * d1[1];
    if !(det.abs() > 1e-9) {
        return [0.0; 9];
    }
    let g = (sum[0] * d2[1] - d2[0] * sum[1]) / det;
    let h = (d1[0] * sum[1] - sum[0] * d1[1]) / det;
    // In the unit square's coordinates (s, t) = ((x + 1)/2, (y + 1)/2).
    let moved = |s: f64, t: f64, one: f64| [0.5 * s, 0.5 * t, one + 0.5 * (s + t)];
    let row = |k: usize| moved(p1[k] - p0[k] + g * p1[k], p3[k] - p0[k] + h * p3[k], p0[k]);
    let (u, v, w) = (row(0), row(1), moved(g, h, 1.0));
    [u[0], u[1], u[2], v[0], v[1], v[2], w[0], w[1], w[2]].map(|term| term / w[2])
}

/// `diagnostic_msgs/DiagnosticStatus`
#[derive(Clone, PartialEq, Debug)]
pub struct DiagnosticStatus {
    /// 0 OK, 1 a warning, 2 an error, 3 stale.
    pub level: u8,
    /// The part.
    pub name: String,
    /// Its state.
    pub message: String,
    /// Values by name.
    pub values: Vec<(String, String)>,
}

/// `diagnostic_msgs/DiagnosticArray`
#[derive(Clone, PartialEq, Debug)]
pub struct DiagnosticArray {
    /// Its time.
    pub header: Header,
    /// The parts.
    pub status: Vec<DiagnosticStatus>,
}

impl RosMessage for DiagnosticArray {
    const TYPE: RosType = RosType::DiagnosticArray;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.header(&self.header);
        cdr.0.length(self.status.len());
        for status in &self.status {
            cdr.0.u8(status.level);
            cdr.0.string(&status.name);
            cdr.0.string(&status.message);
            cdr.0.string("windhover");
            cdr.0.length(status.values.len());
            for (key, value) in &status.values {
                cdr.0.string(key);
                cdr.0.string(value);
            }
        }
    }
}

/// `rcl_interfaces/Log`
#[derive(Clone, PartialEq, Debug)]
pub struct Log {
    /// Its time.
    pub stamp: MonoTime,
    /// 10 debug, 20 info, 30 warning, 40 error, 50 fatal.
    pub level: u8,
    /// Its source.
    pub name: String,
    /// The message.
    pub message: String,
}

impl RosMessage for Log {
    const TYPE: RosType = RosType::Log;

    fn write(&self, cdr: &mut CdrBody<'_>) {
        cdr.time(self.stamp);
        cdr.0.u8(self.level);
        cdr.0.string(&self.name);
        cdr.0.string(&self.message);
        cdr.0.string("");
        cdr.0.string("");
        cdr.0.u32(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_homography_takes_the_square_to_the_corners() {
        let corners = [[101.0, 212.0], [180.0, 205.0], [171.0, 120.0], [110.0, 131.0]];
        let h = homography(&corners);
        for ([x, y], pixel) in [[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]].into_iter().zip(corners) {
            let row = |k: usize| h[k] * x + h[k + 1] * y + h[k + 2];
            let at = [row(0) / row(6), row(3) / row(6)];
            assert!((at[0] - pixel[0]).hypot(at[1] - pixel[1]) < 1e-9, "{at:?} {pixel:?}");
        }
        assert_eq!(homography(&[[5.0, 5.0]; 4]), [0.0; 9]);
    }
}
