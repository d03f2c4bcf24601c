//! Constants that a refined flight determined, as TOML for the configuration.

use std::fmt::Write as _;

use nalgebra::{Rotation3, Vector3};

use crate::config::Config;
use windhover_base::geo::{euler_321, ned_from_body_321};
use windhover_base::settings::MarkerConfig;
use windhover_refine::{Constant, ConstantKind, Refined};

/// The determined constants as TOML; empty where the flight determines none that the configuration has a key for.
///
/// A constant is determined where it differs from the configured value by more than three sigmas.
pub fn adopted(refined: &Refined, config: &Config) -> String {
    let found = Found(&refined.constants);
    let sections = [
        ("[gps]", gps(&found, config)),
        ("[compass]", compass(&found, config)),
        ("[camera]", camera(&found, config)),
        ("[camera.intrinsics]", intrinsics(&found, config)),
        ("[camera.mount]", mount(&found, config)),
    ];
    let mut text = String::new();
    for (name, keys) in sections.into_iter().filter(|(_, keys)| !keys.is_empty()) {
        let gap = if text.is_empty() { "" } else { "\n" };
        let _ = write!(text, "{gap}{name}\n{keys}");
    }
    text + &markers(&found, config)
}

/// What a flight may show to be wrong at once: of more, what is one and what is the other is not known.
const MOST_AT_ONCE: usize = 3;

/// The parts of the configuration that a flight shows to be wrong, where these are too many for one flight to tell their effects
/// apart; empty otherwise. Each absorbs some of the others then, and sigmas do not show it.
pub fn too_many(refined: &Refined, config: &Config) -> Vec<String> {
    let found = Found(&refined.constants);
    let any = |kinds: &[ConstantKind]| kinds.iter().any(|kind| found.settled(*kind).is_some());
    let three = |of: fn(usize) -> ConstantKind| [0, 1, 2].map(of);
    let lens = [0, 1, 2, 3].map(ConstantKind::Lens);
    let angles = [ConstantKind::HeadingBias, ConstantKind::TiltBias(0), ConstantKind::TiltBias(1)];
    let parts = [
        ("the receiver's latency", any(&[ConstantKind::GpsDelay])),
        ("the antenna's place", any(&three(ConstantKind::AntennaAt))),
        ("the compass's angles", any(&angles)),
        ("the compass's latency", any(&[ConstantKind::CompassDelay])),
        ("the camera's exposure offset", any(&[ConstantKind::CameraDelay])),
        ("its read-out", any(&[ConstantKind::Readout])),
        ("its focal length", any(&[ConstantKind::Focal])),
        ("its distortion", any(&lens)),
        ("its place", any(&three(ConstantKind::CameraAt))),
        ("its mount", any(&three(ConstantKind::Mount))),
    ];
    let mut wrong: Vec<String> =
        parts.into_iter().filter(|(_, wrong)| *wrong).map(|(part, _)| part.to_owned()).collect();
    for (target, of) in config.target.iter().enumerate() {
        let tag = |marker: usize| [0, 1, 2, 3].map(|part| ConstantKind::Tag { target, marker, part });
        if (0..of.marker.len()).any(|marker| any(&tag(marker))) {
            wrong.push(format!("the markers of {}", of.name));
        }
    }
    if wrong.len() > MOST_AT_ONCE { wrong } else { Vec::new() }
}

struct Found<'a>(&'a [Constant]);

impl Found<'_> {
    fn settled(&self, kind: ConstantKind) -> Option<&Constant> {
        self.0.iter().find(|constant| constant.kind == kind).filter(|constant| constant.is_settled())
    }

    fn value(&self, kind: ConstantKind) -> f64 {
        self.0.iter().find(|constant| constant.kind == kind).map_or(0.0, |constant| constant.value)
    }

    /// A vector of which at least one component is determined.
    fn vector(&self, of: fn(usize) -> ConstantKind) -> Option<Vector3<f64>> {
        let any = (0..3).any(|i| self.settled(of(i)).is_some());
        any.then(|| Vector3::from_fn(|i, _| self.value(of(i))))
    }
}

fn key(text: &mut String, name: &str, value: f64, decimals: usize, constant: &Constant, scale: f64) {
    let sigma = constant.sigma / scale;
    let _ = writeln!(text, "{name} = {value:.decimals$}    # ± {sigma:.decimals$}");
}

fn place(text: &mut String, name: &str, configured: [f64; 3], by: &Vector3<f64>) {
    let [x, y, z] = std::array::from_fn(|i| configured[i] + by[i]);
    let _ = writeln!(text, "{name} = [{x:.3}, {y:.3}, {z:.3}]");
}

fn gps(found: &Found<'_>, config: &Config) -> String {
    let mut text = String::new();
    if let Some(delay) = found.settled(ConstantKind::GpsDelay) {
        key(&mut text, "latency_ms", config.gps.latency_ms + delay.value * 1e3, 1, delay, 1e-3);
    }
    if let Some(by) = found.vector(ConstantKind::AntennaAt) {
        place(&mut text, "antenna_position_m", config.gps.antenna_position_m, &by);
    }
    text
}

fn compass(found: &Found<'_>, config: &Config) -> String {
    let (mut text, compass, deg) = (String::new(), &config.compass, 1f64.to_radians());
    if let Some(bias) = found.settled(ConstantKind::HeadingBias) {
        key(&mut text, "yaw_offset_deg", compass.yaw_offset_deg - bias.value / deg, 2, bias, deg);
    }
    let offsets = [compass.pitch_offset_deg, compass.roll_offset_deg];
    for (i, (name, offset)) in ["pitch_offset_deg", "roll_offset_deg"].into_iter().zip(offsets).enumerate() {
        if let Some(bias) = found.settled(ConstantKind::TiltBias(i)) {
            key(&mut text, name, offset + bias.value / deg, 2, bias, deg);
        }
    }
    if let Some(delay) = found.settled(ConstantKind::CompassDelay) {
        key(&mut text, "latency_ms", compass.latency_ms + delay.value * 1e3, 1, delay, 1e-3);
    }
    text
}

fn camera(found: &Found<'_>, config: &Config) -> String {
    let mut text = String::new();
    if let Some(delay) = found.settled(ConstantKind::CameraDelay) {
        let offset_ms = config.camera.exposure_offset_ms - delay.value * 1e3;
        key(&mut text, "exposure_offset_ms", offset_ms, 1, delay, 1e-3);
    }
    if let Some(readout) = found.settled(ConstantKind::Readout) {
        let readout_ms = (config.camera.readout_ms + readout.value * 1e3).max(0.0);
        key(&mut text, "readout_ms", readout_ms, 1, readout, 1e-3);
    }
    text
}

fn intrinsics(found: &Found<'_>, config: &Config) -> String {
    let (mut text, lens) = (String::new(), &config.camera.intrinsics);
    if let Some(focal) = found.settled(ConstantKind::Focal) {
        let factor = focal.value.exp();
        for (name, configured) in [("fx", lens.fx), ("fy", lens.fy)] {
            let _ =
                writeln!(text, "{name} = {:.3}    # ± {:.3}", configured * factor, configured * focal.sigma);
        }
    }
    if (0..4).any(|i| found.settled(ConstantKind::Lens(i)).is_some()) {
        let mut terms = lens.distortion;
        (0..4).for_each(|i| terms[i] += found.value(ConstantKind::Lens(i)));
        let terms: Vec<String> = terms.iter().map(|term| format!("{term:.5}")).collect();
        let _ = writeln!(text, "distortion = [{}]", terms.join(", "));
    }
    text
}

fn mount(found: &Found<'_>, config: &Config) -> String {
    let (mut text, mount) = (String::new(), &config.camera.mount);
    if let Some(by) = found.vector(ConstantKind::CameraAt) {
        place(&mut text, "position_m", mount.position_m, &by);
    }
    if let Some(by) = found.vector(ConstantKind::Mount) {
        let configured = [mount.yaw_deg, mount.pitch_deg, mount.roll_deg].map(f64::to_radians);
        let [yaw, pitch, roll] = configured;
        // body_from_camera = Rz(yaw) Ry(pitch) Rx(roll) · base, turned in the body.
        let (yaw, pitch, roll) = euler_321(&(Rotation3::new(by) * ned_from_body_321(yaw, pitch, roll)));
        for (name, angle) in [("yaw_deg", yaw), ("pitch_deg", pitch), ("roll_deg", roll)] {
            let _ = writeln!(text, "{name} = {:.3}", angle.to_degrees());
        }
    }
    text
}

/// Markers that differ from the configuration, as whole blocks that replace the configured ones.
fn markers(found: &Found<'_>, config: &Config) -> String {
    let mut text = String::new();
    for (target, of) in config.target.iter().enumerate() {
        for (marker, configured) in of.marker.iter().enumerate() {
            let kind = |part| ConstantKind::Tag { target, marker, part };
            if (0..4).any(|part| found.settled(kind(part)).is_some()) {
                let [size, forward, right, turn] = std::array::from_fn(|part| found.value(kind(part)));
                let [x, y, z] = configured.position_m;
                let adopted = MarkerConfig {
                    size_m: configured.size_m.map(|edge| rounded(edge * size.exp(), 5)),
                    position_m: [rounded(x + forward, 4), rounded(y + right, 4), z],
                    yaw_deg: rounded(configured.yaw_deg + turn.to_degrees(), 3),
                    ..configured.clone()
                };
                let block = toml::to_string(&adopted).unwrap_or_default();
                let _ = write!(
                    text,
                    "\n# of {}, replaces the configured marker\n[[target.marker]]\n{block}",
                    of.name
                );
            }
        }
    }
    text
}

fn rounded(value: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    (value * scale).round() / scale
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A flight that determines these constants to differ from their expected values.
    fn refined(wrong: &[ConstantKind]) -> Refined {
        let constant = |kind: &ConstantKind| Constant {
            kind: *kind,
            value: 0.02,
            sigma: 1e-3,
            prior: 0.0,
            prior_sigma: 0.01,
        };
        Refined { constants: wrong.iter().map(constant).collect(), ..Refined::default() }
    }

    fn config() -> Config {
        Config::parse(include_str!("../../../config/windhover.toml")).expect("the shipped configuration")
    }

    /// Three parts are printed; of four their names are given, each once, however many of their constants are wrong.
    #[test]
    fn of_too_many_wrong_parts_only_the_names_are_given() {
        use ConstantKind as Kind;
        let config = config();
        let tag = Kind::Tag { target: 0, marker: 0, part: 0 };
        let three = [Kind::GpsDelay, Kind::Mount(0), Kind::Mount(1), Kind::Mount(2), tag];
        assert!(too_many(&refined(&three), &config).is_empty());
        let toml = adopted(&refined(&three), &config);
        let table: toml::Table = toml.parse().expect("TOML");
        assert!(
            table.contains_key("gps") && table.contains_key("camera") && table.contains_key("target"),
            "{toml}"
        );
        let four = [&three[..], &[Kind::HeadingBias, Kind::TiltBias(0)]].concat();
        let markers = format!("the markers of {}", config.target[0].name);
        let named = ["the receiver's latency", "the compass's angles", "its mount", &markers];
        assert_eq!(too_many(&refined(&four), &config), named);
    }

    /// What no key of the configuration holds, and what is within three sigmas, makes no part wrong.
    #[test]
    fn only_settled_parts_of_the_configuration_count() {
        use ConstantKind as Kind;
        let kinds = [
            Kind::GpsDelay,
            Kind::Focal,
            Kind::Readout,
            Kind::Drag,
            Kind::Trim(0),
            Kind::Iron(0),
            Kind::Lens(0),
        ];
        let mut found = refined(&kinds);
        found.constants[0].sigma = 9e-3;
        assert!(too_many(&found, &config()).is_empty());
        found.constants[0].sigma = 1e-3;
        assert_eq!(too_many(&found, &config()).len(), 4);
    }
}
