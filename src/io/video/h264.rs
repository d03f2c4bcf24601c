//! Frames to H.264 by OpenH264, each with its time after MISB ST 0604.

use openh264::OpenH264API;
use openh264::encoder::{
    Encoder, EncoderConfig, FrameRate, FrameType, IntraFramePeriod, QpRange, RateControlMode, SpsPpsStrategy,
    UsageType,
};
use openh264::formats::YUVBuffer;

use windhover_base::msg::{GrayImage, RgbImage};

/// Quantisation steps (0 none, 51 coarsest): for viewing the ground, not for measuring in it.
const QUALITY: QpRange = QpRange::new(20, 28);
/// Period of key frames, seconds.
const KEY_EVERY_S: f64 = 2.0;
/// Access unit delimiter: any kind of slice follows.
const DELIMITER: [u8; 6] = [0, 0, 0, 1, 9, 0xf0];

/// Why a frame could not be encoded.
#[derive(Debug, thiserror::Error)]
#[error("the frame cannot be encoded as H.264: {0}")]
pub struct VideoError(String);

/// An encoder for frames of one size.
pub struct H264Encoder {
    encoder: Encoder,
    size: (usize, usize),
}

impl H264Encoder {
    /// An encoder for frames of this size at about this rate; a last odd row or column is left out.
    ///
    /// # Errors
    /// The encoder does not accept such frames.
    pub fn new(width: usize, height: usize, fps: f64) -> Result<Self, VideoError> {
        let size = (width & !1, height & !1);
        if size.0 < 16 || size.1 < 16 || size.0 > 4096 || size.1 > 4096 {
            return Err(VideoError(format!(
                "{width} by {height} pixels are not a possible size (16 to 4096)"
            )));
        }
        let config = EncoderConfig::new()
            .max_frame_rate(FrameRate::from_hz(fps as f32))
            .rate_control_mode(RateControlMode::Off)
            .qp(QUALITY)
            .usage_type(UsageType::CameraVideoRealTime)
            .sps_pps_strategy(SpsPpsStrategy::ConstantId)
            .intra_frame_period(IntraFramePeriod::from_num_frames((fps * KEY_EVERY_S).ceil() as u32))
            .scene_change_detect(false)
            .skip_frames(false)
            .num_threads(1);
        let encoder = Encoder::with_api_config(OpenH264API::from_source(), config)
            .map_err(|error| VideoError(error.to_string()))?;
        Ok(Self { encoder, size })
    }

    /// The access unit of a frame, and whether it is a key frame.
    ///
    /// # Errors
    /// The frame is of another size, or the encoder fails.
    pub fn encode(
        &mut self,
        gray: &GrayImage,
        rgb: Option<&RgbImage>,
    ) -> Result<(Vec<u8>, bool), VideoError> {
        let (width, height) = self.size;
        if (gray.width & !1, gray.height & !1) != self.size {
            return Err(VideoError(format!("it is {} by {} pixels", gray.width, gray.height)));
        }
        let planes = YUVBuffer::from_vec(planes(gray, rgb, width, height), width, height);
        let stream = self.encoder.encode(&planes).map_err(|error| VideoError(error.to_string()))?;
        let key = matches!(stream.frame_type(), FrameType::IDR);
        let mut unit = DELIMITER.to_vec();
        stream.write_vec(&mut unit);
        Ok((unit, key))
    }
}

/// Luma, then both colours at half the size, in the limited range of ITU-R BT.601.
fn planes(gray: &GrayImage, rgb: Option<&RgbImage>, width: usize, height: usize) -> Vec<u8> {
    let mut planes = vec![128; width * height * 3 / 2];
    let (luma, chroma) = planes.split_at_mut(width * height);
    let (blue, red) = chroma.split_at_mut(width * height / 4);
    for row in 0..height {
        let from = &gray.data[row * gray.stride..row * gray.stride + width];
        for (out, grey) in luma[row * width..(row + 1) * width].iter_mut().zip(from) {
            // 16 to 235.
            *out = 16 + ((u32::from(*grey) * 219 + 127) / 255) as u8;
        }
    }
    let Some(rgb) = rgb else { return planes };
    for (row, (blue, red)) in blue.chunks_mut(width / 2).zip(red.chunks_mut(width / 2)).enumerate() {
        for column in 0..width / 2 {
            // The top-left pixel represents each block of four.
            let at = 3 * (2 * row * rgb.width + 2 * column);
            let [r, g, b] = [0, 1, 2].map(|k| f64::from(rgb.data[at + k]));
            let limited = |x: f64| (x + 128.0).round().clamp(16.0, 240.0) as u8;
            blue[column] = limited(-0.148 * r - 0.291 * g + 0.439 * b);
            red[column] = limited(0.439 * r - 0.368 * g - 0.071 * b);
        }
    }
    planes
}

/// What ST 0603's status tells of a time.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct TimeStatus {
    /// It is locked to UTC.
    pub is_utc: bool,
    /// It does not continue the one before: by so many microseconds, 0 where it does.
    pub step_us: i64,
}

impl TimeStatus {
    /// Bits 7 not locked, 6 discontinuity, 5 backward, the others one.
    fn byte(self) -> u8 {
        let locked = if self.is_utc { 0x1f } else { 0x9f };
        let step = match self.step_us {
            0 => 0,
            1.. => 0x40,
            _ => 0x60,
        };
        locked | step
    }
}

/// The unit with its time as supplemental information (MISB ST 0604, "MISPmicrosectime") before its first slice.
pub fn with_time(unit: &[u8], unix_us: u64, status: TimeStatus) -> Vec<u8> {
    let mut sei = vec![0, 0, 0, 1, 6, 5, 28];
    sei.extend_from_slice(b"MISPmicrosectime");
    sei.push(status.byte());
    for (k, pair) in unix_us.to_be_bytes().chunks(2).enumerate() {
        if k > 0 {
            sei.push(0xff);
        }
        sei.extend_from_slice(pair);
    }
    sei.push(0x80);
    let at = first_slice(unit).unwrap_or(unit.len());
    [&unit[..at], &sei, &unit[at..]].concat()
}

/// Where the start code of the first slice (types 1 and 5) begins.
fn first_slice(unit: &[u8]) -> Option<usize> {
    let at = unit.windows(4).position(|w| w[..3] == [0, 0, 1] && matches!(w[3] & 0x1f, 1 | 5))?;
    Some(if at > 0 && unit[at - 1] == 0 { at - 1 } else { at })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_that_steps_says_so() {
        let byte = |is_utc, step_us| TimeStatus { is_utc, step_us }.byte();
        assert_eq!([byte(true, 0), byte(false, 0), byte(true, 7), byte(true, -7)], [0x1f, 0x9f, 0x5f, 0x7f]);
        let picture = [0, 0, 0, 1, 9, 0xf0, 0, 0, 0, 1, 0x65, 1];
        let unit = with_time(&picture, 0x0102_0304_0506_0708, TimeStatus::default());
        assert_eq!((&unit[..6], &unit[unit.len() - 6..]), (&picture[..6], &picture[6..]));
        assert_eq!(unit[29..41], [0x9f, 1, 2, 0xff, 3, 4, 0xff, 5, 6, 0xff, 7, 8]);
    }
}
