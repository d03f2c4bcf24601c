//! Checks of the targets and their markers.

use windhover_base::settings::{MarkerConfig, MarkerKind, TargetConfig, TargetModel};

use super::Config;
use super::check::{ConfigError, refuse, within};

/// Most targets: all are states of one filter, whose memory grows with the square of their number.
const MOST_TARGETS: usize = 32;
/// Most markers of all targets together.
const MOST_MARKERS: usize = 256;

impl Config {
    pub(super) fn check_targets(&self) -> Result<(), ConfigError> {
        if self.target.is_empty() {
            return refuse("target", "there is no [[target]]: name the vehicle to watch");
        }
        let markers: usize = self.target.iter().map(|target| target.marker.len()).sum();
        for (key, count, most) in
            [("target", self.target.len(), MOST_TARGETS), ("target.marker", markers, MOST_MARKERS)]
        {
            if count > most {
                refuse(key, format!("there are {count}; the most for one helicopter is {most}"))?;
            }
        }
        let mut names = std::collections::BTreeSet::new();
        let mut tags = std::collections::BTreeSet::new();
        for target in &self.target {
            check_target(target)?;
            if !names.insert(&target.name) {
                refuse("target.name", format!("two targets are called {:?}", target.name))?;
            }
            for marker in &target.marker {
                if let (Some(family), Some(id)) = (marker.family, marker.id)
                    && !tags.insert((family.name(), id))
                {
                    refuse("target.marker.id", format!("tag {id} of {} is used twice", family.name()))?;
                }
            }
        }
        Ok(())
    }
}

fn check_target(target: &TargetConfig) -> Result<(), ConfigError> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    if target.name.is_empty() || !target.name.chars().all(allowed) {
        refuse("target.name", format!("{:?} must be letters, digits, - and _ only", target.name))?;
    }
    match (target.model, target.wheelbase_m) {
        (TargetModel::Ackermann, None) => {
            refuse("target.wheelbase_m", "an ackermann target needs wheelbase_m")?;
        }
        (_, Some(wheelbase)) => within("target.wheelbase_m", wheelbase, 0.05, 50.0)?,
        (_, None) => {}
    }
    within("target.reference_m", target.reference_m, -50.0, 50.0)?;
    if target.marker.is_empty() {
        refuse("target.marker", format!("target {:?} has no [[target.marker]]", target.name))?;
    }
    target.marker.iter().try_for_each(check_marker)
}

fn check_marker(marker: &MarkerConfig) -> Result<(), ConfigError> {
    for (axis, value) in marker.position_m.iter().enumerate() {
        within(format!("target.marker.position_m[{axis}]"), *value, -50.0, 50.0)?;
    }
    within("target.marker.yaw_deg", marker.yaw_deg, -360.0, 360.0)?;
    match marker.kind {
        MarkerKind::Apriltag => {
            let (Some(family), Some(id)) = (marker.family, marker.id) else {
                return refuse("target.marker", "an apriltag needs family and id");
            };
            if id as usize >= family.codes() {
                refuse("target.marker.id", format!("{} has ids 0 to {}", family.name(), family.codes() - 1))?;
            }
            within("target.marker.border", f64::from(marker.border), 1.0, 2.0)?;
            match marker.size_m {
                Some(size) => within("target.marker.size_m", size, 0.005, 50.0),
                None => refuse("target.marker.size_m", "an apriltag needs the edge of its black square"),
            }
        }
        MarkerKind::Disc => {
            if marker.brightness.is_some() == marker.color.is_some() {
                refuse("target.marker", "a disc needs either brightness or color")?;
            }
            if let Some(color) = &marker.color
                && !(color.len() == 7
                    && color.starts_with('#')
                    && color[1..].chars().all(|c| c.is_ascii_hexdigit()))
            {
                refuse("target.marker.color", format!("{color:?} is not #rrggbb"))?;
            }
            match marker.diameter_m {
                Some(d) => within("target.marker.diameter_m", d, 0.005, 50.0),
                None => refuse("target.marker.diameter_m", "a disc needs its diameter"),
            }
        }
    }
}
