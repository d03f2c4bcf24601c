//! The camera for ground stations: a component of the helicopter that tracks on its own.

use mavlink::MessageData as _;
use mavlink::dialects::development::*;

use windhover_base::msg::MarkerDetection;
use windhover_base::settings::CameraConfig;
use windhover_base::time::Span;

use super::encoder::CAMERA;
use super::packet::Sender;

/// The content of the camera's messages.
#[derive(Clone, Debug)]
pub struct Camera {
    width_px: u32,
    height_px: u32,
    sequence: u8,
}

impl Camera {
    /// The camera of this configuration.
    pub fn new(config: &CameraConfig) -> Self {
        Self { width_px: config.width, height_px: config.height, sequence: 0 }
    }

    /// The number of the next message.
    pub fn next_sequence(&mut self) -> u8 {
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        sequence
    }

    /// The box around markers: left, top, right, bottom as shares of the picture; `None` without markers.
    pub fn around<'a>(&self, seen: impl Iterator<Item = &'a MarkerDetection>) -> Option<[f32; 4]> {
        let (width, height) = (f64::from(self.width_px.max(1)), f64::from(self.height_px.max(1)));
        let boxed = |seen: &MarkerDetection| {
            let (center, half) = (seen.center_px, 0.5 * seen.size_px);
            let corners = seen.corners_px.map_or_else(
                || vec![center.add_scalar(-half), center.add_scalar(half)],
                |corners| corners.to_vec(),
            );
            let low = corners.iter().fold(center, |low, corner| low.inf(corner));
            let high = corners.iter().fold(center, |high, corner| high.sup(corner));
            (low, high)
        };
        let whole = seen.map(boxed).reduce(|a, b| (a.0.inf(&b.0), a.1.sup(&b.1)));
        // The centre of the top-left pixel is (0, 0): the picture begins half a pixel before it.
        let share = |px: f64, size: f64| ((px + 0.5) / size).clamp(0.0, 1.0) as f32;
        whole.map(|(low, high)| {
            [share(low.x, width), share(low.y, height), share(high.x, width), share(high.y, height)]
        })
    }

    /// The answers to a command. Commands to other systems, and other messages, get none.
    #[expect(deprecated, reason = "ground stations still use the commands from before 2019")]
    pub fn answers(&self, from: Sender, system: u8, message: &MavMessage, now: Span) -> Vec<MavMessage> {
        let MavMessage::COMMAND_LONG(asked) = message else { return Vec::new() };
        if (asked.target_system, asked.target_component) != (system, CAMERA) {
            return Vec::new();
        }
        let wanted = match asked.command {
            MavCmd::MAV_CMD_REQUEST_MESSAGE => Some(asked.param1 as u32),
            MavCmd::MAV_CMD_REQUEST_CAMERA_INFORMATION => Some(CAMERA_INFORMATION_DATA::ID),
            MavCmd::MAV_CMD_REQUEST_CAMERA_SETTINGS => Some(CAMERA_SETTINGS_DATA::ID),
            _ => None,
        };
        let answer = match wanted {
            Some(CAMERA_INFORMATION_DATA::ID) => Some(self.information(now)),
            Some(CAMERA_SETTINGS_DATA::ID) => Some(settings(now)),
            _ => None,
        };
        // The tracking messages have the rate of positions, whatever interval is requested.
        let comes_anyway = asked.command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL
            && [CAMERA_TRACKING_GEO_STATUS_DATA::ID, CAMERA_TRACKING_IMAGE_STATUS_DATA::ID]
                .contains(&(asked.param1 as u32));
        let result = match answer.is_some() || comes_anyway {
            true => MavResult::MAV_RESULT_ACCEPTED,
            false => MavResult::MAV_RESULT_UNSUPPORTED,
        };
        let ack = MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
            command: asked.command,
            result,
            target_system: from.system,
            target_component: from.component,
            ..COMMAND_ACK_DATA::DEFAULT
        });
        std::iter::once(ack).chain(answer).collect()
    }

    fn information(&self, now: Span) -> MavMessage {
        let pixels = |n: u32| u16::try_from(n).unwrap_or(0);
        MavMessage::CAMERA_INFORMATION(CAMERA_INFORMATION_DATA {
            time_boot_ms: (now.ns() / 1_000_000) as u32,
            vendor_name: text("windhover"),
            model_name: text("tracking camera"),
            focal_length: f32::NAN,
            sensor_size_h: f32::NAN,
            sensor_size_v: f32::NAN,
            resolution_h: pixels(self.width_px),
            resolution_v: pixels(self.height_px),
            flags: CameraCapFlags::CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
                | CameraCapFlags::CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS,
            ..CAMERA_INFORMATION_DATA::DEFAULT
        })
    }
}

fn settings(now: Span) -> MavMessage {
    MavMessage::CAMERA_SETTINGS(CAMERA_SETTINGS_DATA {
        time_boot_ms: (now.ns() / 1_000_000) as u32,
        mode_id: CameraMode::CAMERA_MODE_VIDEO,
        zoomLevel: f32::NAN,
        focusLevel: f32::NAN,
        camera_device_id: 0,
    })
}

/// A text as a field of fixed length, padded with zeros.
fn text<const N: usize>(words: &str) -> [u8; N] {
    let bytes = words.as_bytes();
    std::array::from_fn(|i| bytes.get(i).copied().unwrap_or(0))
}
