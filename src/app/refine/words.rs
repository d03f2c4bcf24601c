//! Names and units of the refined constants, and remarks on the result.

use crate::app::flight::Flight;
use crate::text::counted;
use windhover_base::msg::{FeltTilt, MarkerId};
use windhover_base::settings::{MarkerKind, TargetConfig};
use windhover_refine::{Constant, ConstantKind, Refined, Source};

/// A constant in readable form.
#[derive(Clone, PartialEq, Debug)]
pub struct ConstantWords {
    /// Its name.
    pub name: String,
    /// Its unit; empty where it has none.
    pub unit: &'static str,
    /// The size of one such unit in the constant's own unit.
    pub scale: f64,
}

const AXES: [&str; 3] = ["forward", "right", "down"];
const TURNS: [&str; 3] = ["roll", "pitch", "yaw"];
const LENS: [&str; 4] = ["k1", "k2", "p1", "p2"];
const IRON: [&str; 4] = ["iron_sine", "iron_cosine", "iron_sine_2", "iron_cosine_2"];

/// Name and unit of a constant.
pub fn constant_words(kind: ConstantKind, targets: &[TargetConfig]) -> ConstantWords {
    use ConstantKind as Kind;
    let (deg, ms, percent) = (("deg", 1f64.to_radians()), ("ms", 1e-3), ("%", 1e-2));
    let metre = ("m", 1.0);
    let (name, (unit, scale)) = match kind {
        Kind::Trim(i) => (format!("trim_{}", AXES[i]), deg),
        Kind::HeadingBias => ("compass_heading_bias".into(), deg),
        Kind::TiltShare => ("compass_tilt_share".into(), ("", 1.0)),
        Kind::TiltBias(i) => (format!("compass_{}_bias", ["pitch", "roll"][i]), deg),
        Kind::GpsDelay => ("gps_delay".into(), ms),
        Kind::Drag => ("drag".into(), ("1/s", 1.0)),
        Kind::Iron(i) => (format!("compass_{}", IRON[i]), deg),
        Kind::CompassDelay => ("compass_delay".into(), ms),
        Kind::CameraDelay => ("camera_delay".into(), ms),
        Kind::Readout => ("camera_readout".into(), ms),
        Kind::Mount(i) => (format!("mount_{}", TURNS[i]), deg),
        Kind::CameraAt(i) => (format!("camera_{}", AXES[i]), metre),
        Kind::AntennaAt(i) => (format!("antenna_{}", AXES[i]), metre),
        Kind::VelocityDelay => ("gps_velocity_delay".into(), ms),
        Kind::Focal => ("focal_length".into(), percent),
        Kind::Lens(i) => (format!("lens_{}", LENS[i]), ("", 1.0)),
        Kind::Tag { target, marker, part } => {
            let what = ["size", "forward", "right", "turn"][part];
            (format!("{}_{what}", marker_name(targets, target, marker)), [percent, metre, metre, deg][part])
        }
    };
    ConstantWords { name, unit, scale }
}

fn marker_name(targets: &[TargetConfig], target: usize, marker: usize) -> String {
    let Some(config) = targets.get(target) else { return format!("target_{target}_marker_{marker}") };
    match config.marker.get(marker) {
        Some(tag) if tag.kind == MarkerKind::Apriltag => {
            format!("{}_tag_{}", config.name, tag.id.unwrap_or_default())
        }
        _ => format!("{}_marker_{marker}", config.name),
    }
}

/// Name of a source.
pub fn source_name(source: Source, targets: &[TargetConfig]) -> String {
    let of = |target: usize| targets.get(target).map_or("target", |config| config.name.as_str());
    match source {
        Source::GpsPosition => "gps_position".into(),
        Source::GpsVelocity => "gps_velocity".into(),
        Source::Heading => "compass_heading".into(),
        Source::Tilt => "compass_tilt".into(),
        Source::Feature => "feature".into(),
        Source::Marker(target) => format!("{}/marker", of(target)),
        Source::TiltMotion => "tilt_motion".into(),
        Source::YawMotion => "yaw_motion".into(),
        Source::Gust => "gust".into(),
        Source::Thrust => "thrust".into(),
        Source::Vibration => "vibration".into(),
        Source::Shake => "camera_shake".into(),
        Source::ShakeRoll => "camera_shake_roll".into(),
        Source::Drive(target) => format!("{}/drive", of(target)),
        Source::Turn(target) => format!("{}/turn", of(target)),
        Source::Sway(target) => format!("{}/sway", of(target)),
        Source::Slip(target) => format!("{}/slip", of(target)),
        Source::Heave(target) => format!("{}/heave", of(target)),
        Source::Outside => "position_from_outside".into(),
        Source::Known => "known".into(),
    }
}

/// Name of a marker that was seen.
pub(super) fn seen_name(marker: MarkerId) -> String {
    match marker {
        MarkerId::Tag { family, id } => format!("{} {id}", family.name()),
        MarkerId::Disc { target, marker } => format!("disc {target}.{marker}"),
    }
}

/// `mount_pitch  1.02 ± 0.05 deg`
pub(super) fn in_unit(constant: &Constant, words: &ConstantWords) -> [f64; 4] {
    let Constant { value, sigma, prior, prior_sigma, .. } = *constant;
    [value, sigma, prior, prior_sigma].map(|figure| figure / words.scale)
}

/// Remarks on the flight for its reader.
pub(super) fn remarks(flight: &Flight, refined: &Refined) -> Vec<String> {
    let mut remarks = Vec::new();
    if !flight.had_frames() {
        remarks.push("no frame was received from the camera: only the helicopter is estimated".to_owned());
    } else if refined.targets.iter().all(|(_, e)| e.state.is_none()) {
        remarks.push("no marker of a target was seen: only the helicopter is estimated".to_owned());
    }
    let silences = refined.begins.len().saturating_sub(1);
    if silences > 0 {
        let at: Vec<String> =
            refined.begins.iter().skip(1).map(|(_, t)| format!("{:.1} s", flight.seconds(*t))).collect();
        remarks.push(format!(
            "{} without fixes and compass: the trajectory starts again at {}",
            counted(silences, "long silence"),
            at.join(", ")
        ));
    }
    for (t, why) in &refined.resets {
        remarks.push(format!(
            "the filter that gave the first values was reset at {:.1} s: {why}",
            flight.seconds(*t)
        ));
    }
    if refined.features.1 > 0 {
        let moving = counted(refined.features.1, "ground feature");
        remarks.push(format!("{moving} left out: they lie on something that moves"));
    }
    for clock in refined.clocks.iter().filter(|clock| clock.is_settled()) {
        let other = if clock.other == ConstantKind::GpsDelay {
            "the receiver's fixes"
        } else {
            "the compass's readings"
        };
        remarks.push(format!(
            "frames are {:.1} ± {:.1} ms {} against {other} than configured; the flight does not show which of the two is wrong",
            clock.late_s.abs() * 1e3,
            clock.sigma_s * 1e3,
            if clock.late_s < 0.0 { "earlier" } else { "later" }
        ));
    }
    match refined.felt {
        Some(FeltTilt::Force) => remarks.push("the compass's tilt sensor measures specific force".to_owned()),
        Some(FeltTilt::Share(share)) => {
            remarks.push(format!("the compass's tilt sensor reads {:.0} % of the tilt", 100.0 * share));
        }
        Some(FeltTilt::Attitude) | None => {}
    }
    remarks
}
