//! The fields of messages as ROS 1 and ROS 2 serialise them, and the supported messages.

use std::sync::Arc;

use nalgebra::{Quaternion, Vector3};

use crate::io::ros::frame_encoding;
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::{MonoTime, NS_PER_S, Span};

/// How a message is serialised.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Wire {
    /// ROS 1: packed.
    Ros1,
    /// ROS 2: CDR, little endian.
    Cdr,
}

/// A stamp that is further than this from the arrival of its message is invalid or of another clock.
const STAMP_WITHIN: Span = Span::from_ns(10 * NS_PER_S);

/// Reads one field after another.
pub(super) struct Fields<'a> {
    body: &'a [u8],
    at: usize,
    wire: Wire,
}

impl<'a> Fields<'a> {
    pub(super) fn new(wire: Wire, data: &'a [u8]) -> Option<Self> {
        let body = match wire {
            Wire::Ros1 => data,
            Wire::Cdr => data.strip_prefix(&[0, 1])?.get(2..)?,
        };
        Some(Self { body, at: 0, wire })
    }

    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        if self.wire == Wire::Cdr {
            self.at = self.at.next_multiple_of(N);
        }
        let bytes = self.body.get(self.at..)?.first_chunk::<N>()?;
        self.at += N;
        Some(*bytes)
    }

    fn u8(&mut self) -> Option<u8> {
        self.take().map(u8::from_le_bytes)
    }

    fn u16(&mut self) -> Option<u16> {
        self.take().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn f64(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Some(values)
    }

    fn bytes(&mut self) -> Option<&'a [u8]> {
        let length = usize::try_from(self.u32()?).ok()?;
        let bytes = self.body.get(self.at..self.at.checked_add(length)?)?;
        self.at += length;
        Some(bytes)
    }

    fn string(&mut self) -> Option<&'a str> {
        let bytes = self.bytes()?;
        std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes)).ok()
    }

    /// The message's time of validity: its stamp, or its arrival where the stamp is invalid.
    fn header(&mut self, came: MonoTime) -> Option<MonoTime> {
        if self.wire == Wire::Ros1 {
            self.u32()?;
        }
        let (seconds, nanos) = (i64::from(self.u32()?), i64::from(self.u32()?));
        self.string()?;
        let stamp = MonoTime::from_ns(seconds * NS_PER_S + nanos);
        Some(if (stamp - came).abs() <= STAMP_WITHIN { stamp } else { came })
    }
}

/// `sensor_msgs/Image` as a frame.
pub(super) fn image(fields: &mut Fields<'_>, came: MonoTime, index: u32) -> Option<FramePayload> {
    let t_exposure = fields.header(came)?;
    let (height, width) = (fields.u32()?, fields.u32()?);
    let encoding = frame_encoding(fields.string()?);
    let big_endian = fields.u8()? != 0;
    let stride = fields.u32()?;
    let encoding =
        if big_endian && encoding == FrameEncoding::Y16 { FrameEncoding::Unknown } else { encoding };
    Some(FramePayload {
        index,
        t_exposure,
        encoding,
        width,
        height,
        stride,
        data: Arc::from(fields.bytes()?),
    })
}

/// `sensor_msgs/CompressedImage` as a frame; where its text does not name the format, its first bytes do.
pub(super) fn compressed(fields: &mut Fields<'_>, came: MonoTime, index: u32) -> Option<FramePayload> {
    let t_exposure = fields.header(came)?;
    fields.string()?;
    let data = fields.bytes()?;
    let encoding = match data {
        [0xff, 0xd8, ..] => FrameEncoding::Jpeg,
        [0x89, b'P', b'N', b'G', ..] => FrameEncoding::Png,
        _ => FrameEncoding::Unknown,
    };
    Some(FramePayload { index, t_exposure, encoding, width: 0, height: 0, stride: 0, data: Arc::from(data) })
}

/// `sensor_msgs/NavSatFix`
pub(super) struct NavSatFix {
    pub t: MonoTime,
    /// −1 no fix, 0 a fix, 1 with corrections from satellites, 2 from the ground.
    pub status: i8,
    pub lat_deg: f64,
    pub lon_deg: f64,
    /// Above the ellipsoid.
    pub altitude_m: f64,
    /// One sigma of the horizontal position and of the height, where given.
    pub sigmas_m: Option<(f64, f64)>,
}

pub(super) fn nav_sat_fix(fields: &mut Fields<'_>, came: MonoTime) -> Option<NavSatFix> {
    let t = fields.header(came)?;
    let status = fields.u8()? as i8;
    fields.u16()?;
    let [lat_deg, lon_deg, altitude_m] = fields.f64s()?;
    let covariance = fields.f64s::<9>()?;
    let stated = fields.u8()? != 0 && covariance[0] + covariance[4] > 0.0;
    let sigmas_m = stated.then(|| ((covariance[0] + covariance[4]).sqrt(), covariance[8].max(0.0).sqrt()));
    Some(NavSatFix { t, status, lat_deg, lon_deg, altitude_m, sigmas_m })
}

/// `sensor_msgs/Imu`; fields that its covariances mark as absent are `None`.
pub(super) struct Imu {
    pub t: MonoTime,
    /// East-north-up from the sensor's axes (forward, left, up).
    pub orientation: Option<Quaternion<f64>>,
    pub rate_rps: Option<Vector3<f64>>,
    pub force_mps2: Option<Vector3<f64>>,
}

pub(super) fn imu(fields: &mut Fields<'_>, came: MonoTime) -> Option<Imu> {
    let t = fields.header(came)?;
    let [x, y, z, w] = fields.f64s()?;
    let with_orientation = fields.f64s::<9>()?[0] != -1.0;
    let q = Quaternion::new(w, x, y, z);
    let orientation = Some(q).filter(|q| with_orientation && (0.9..1.1).contains(&q.norm()));
    let mut vector = || {
        let v = Vector3::from(fields.f64s::<3>()?);
        let there = fields.f64s::<9>()?[0] != -1.0;
        Some(Some(v).filter(|v| there && v.iter().all(|x| x.is_finite())))
    };
    let (rate_rps, force_mps2) = (vector()?, vector()?);
    Some(Imu { t, orientation, rate_rps, force_mps2 })
}

/// `sensor_msgs/MagneticField`: its time, and the field in the sensor's axes (forward, left, up).
pub(super) fn magnetic_field(fields: &mut Fields<'_>, came: MonoTime) -> Option<(MonoTime, Vector3<f64>)> {
    let t = fields.header(came)?;
    let field = Vector3::from(fields.f64s::<3>()?);
    (field.norm().is_finite() && field.norm() > 0.0).then_some((t, field))
}
