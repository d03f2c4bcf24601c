//! The camera: images, lens, detections.

use super::{CAMERA, RosTranslator};
use crate::io::proto::windhover::{Detections, Marker};
use crate::io::proto::{foxglove as fox, host_time};
use crate::io::ros::{
    AprilTag, AprilTagDetectionArray, CameraInfo, CompressedImage, Header, Image, RosRecord, encoding_name,
};
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::MonoTime;

/// The encoding of an image.
enum Form {
    Compressed(&'static str),
    /// Bytes without conversion, under this name.
    Raw(&'static str),
    /// A name for the first plane, which is luma.
    Luma,
    /// ROS has no name for it.
    None,
}

fn form(encoding: FrameEncoding) -> Form {
    match (encoding, encoding_name(encoding)) {
        (FrameEncoding::Jpeg, _) => Form::Compressed("jpeg"),
        (FrameEncoding::Png, _) => Form::Compressed("png"),
        (FrameEncoding::Nv12, _) => Form::Luma,
        (_, Some(name)) => Form::Raw(name),
        (_, None) => Form::None,
    }
}

impl RosTranslator {
    /// `/camera/image/compressed` or `/camera/image`, with `/camera/camera_info` of the same stamp.
    pub(super) fn image(&self, frame: &FramePayload, log: MonoTime, out: &mut Vec<RosRecord>) {
        let t = frame.t_exposure;
        let header = Header::new(t, self.frame(CAMERA));
        let image = |encoding, data| Image {
            header: header.clone(),
            height: frame.height,
            width: frame.width,
            encoding,
            step: frame.stride,
            data,
        };
        let luma = frame.stride as usize * frame.height as usize;
        out.push(match form(frame.encoding) {
            Form::Compressed(format) => {
                let image = CompressedImage { header: header.clone(), format, data: &frame.data };
                RosRecord::new(self.topic("/camera/image/compressed"), log, t, &image)
            }
            Form::Raw(encoding) => {
                RosRecord::new(self.topic("/camera/image"), log, t, &image(encoding, &frame.data))
            }
            Form::Luma if frame.data.len() >= luma => {
                RosRecord::new(self.topic("/camera/image"), log, t, &image("mono8", &frame.data[..luma]))
            }
            Form::Luma | Form::None => return,
        });
        if let Some(lens) = &self.lens {
            let info = CameraInfo { header, ..lens.clone() };
            out.push(RosRecord::new(self.topic("/camera/camera_info"), log, t, &info));
        }
    }

    /// `/camera/thumbnail/compressed`: a picture of the camera for viewers, JPEG, its exposure at `t`.
    pub fn thumbnail(&self, t: MonoTime, jpeg: &[u8]) -> RosRecord {
        let image =
            CompressedImage { header: Header::new(t, self.frame(CAMERA)), format: "jpeg", data: jpeg };
        RosRecord::new(self.topic("/camera/thumbnail/compressed"), t, t, &image)
    }

    /// The lens in the form of `sensor_msgs`; distortion of another number of terms is written as zeros.
    pub(super) fn lens_of(&self, calibration: fox::CameraCalibration) -> CameraInfo {
        let distortion_model = match calibration.distortion_model.as_str() {
            "kannala_brandt" | "fisheye" => "equidistant".to_owned(),
            _ => calibration.distortion_model,
        };
        CameraInfo {
            header: Header::new(host_time(calibration.timestamp.as_ref()), self.frame(CAMERA)),
            height: calibration.height,
            width: calibration.width,
            distortion_model,
            d: calibration.d,
            k: calibration.k.try_into().unwrap_or_default(),
            p: calibration.p.try_into().unwrap_or_default(),
        }
    }

    /// `/camera/detections`: tags, and discs as the family `disc` with four corners at their centre.
    pub(super) fn detections(&self, seen: &Detections, log: MonoTime) -> RosRecord {
        let t = host_time(seen.timestamp.as_ref());
        let array = AprilTagDetectionArray {
            header: Header::new(t, self.frame(CAMERA)),
            detections: seen.markers.iter().map(marker).collect(),
        };
        RosRecord::new(self.topic("/camera/detections"), log, t, &array)
    }
}

fn marker(marker: &Marker) -> AprilTag {
    let centre = [marker.center_u, marker.center_v];
    let corners = match marker.corners[..] {
        [u0, v0, u1, v1, u2, v2, u3, v3] => [[u3, v3], [u2, v2], [u1, v1], [u0, v0]],
        _ => [centre; 4],
    };
    AprilTag {
        family: if marker.kind == "disc" { "disc".into() } else { library_name(&marker.family) },
        id: i32::try_from(marker.id).unwrap_or(i32::MAX),
        hamming: i32::try_from(marker.hamming).unwrap_or(i32::MAX),
        decision_margin: marker.margin,
        centre,
        corners,
    }
}

/// The family as the AprilTag library names it.
fn library_name(family: &str) -> String {
    match family {
        "41h12" | "52h13" => format!("tagStandard{family}"),
        "48h12" => format!("tagCustom{family}"),
        _ if family.starts_with("circle") => format!("tagCircle{}", &family["circle".len()..]),
        _ if family.starts_with(|c: char| c.is_ascii_digit()) => format!("tag{family}"),
        other => other.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn families_have_the_librarys_names() {
        for (ours, theirs) in [
            ("36h11", "tag36h11"),
            ("41h12", "tagStandard41h12"),
            ("48h12", "tagCustom48h12"),
            ("circle21h7", "tagCircle21h7"),
            ("aruco_5x5_50", "aruco_5x5_50"),
        ] {
            assert_eq!(library_name(ours), theirs);
        }
    }
}
