//! The vehicles to watch and the markers on them.

use serde::{Deserialize, Serialize};

use crate::msg::TagFamily;

/// `[[target]]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TargetConfig {
    /// Name in topics and files.
    pub name: String,
    /// Its model of motion.
    pub model: TargetModel,
    /// Distance between the axles, metres; needed by `ackermann`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wheelbase_m: Option<f64>,
    /// Reported point, metres ahead of the rear axle.
    #[serde(default)]
    pub reference_m: f64,
    /// Its markers.
    pub marker: Vec<MarkerConfig>,
}

/// The model of motion of a target.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TargetModel {
    /// Rear-axle bicycle.
    Ackermann,
    /// Turns on the spot.
    Unicycle,
    /// Does not move: a surveyed or to-be-surveyed point.
    Static,
}

/// `[[target.marker]]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkerConfig {
    /// Tag or disc.
    pub kind: MarkerKind,
    /// Family of a tag.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub family: Option<TagFamily>,
    /// Identity of a tag.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub id: Option<u32>,
    /// Width of a tag's border, cells: 1 as printed by the authors of the families, 2 as by Kalibr.
    #[serde(default = "one_cell", skip_serializing_if = "is_one_cell")]
    pub border: u8,
    /// Whether left and right of a tag are exchanged: seen in a mirror or through the sheet's back.
    #[serde(default, skip_serializing_if = "is_not")]
    pub mirrored: bool,
    /// Whether black and white of a tag are exchanged.
    #[serde(default, skip_serializing_if = "is_not")]
    pub inverted: bool,
    /// Edge of a tag's black square, its whole border included, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size_m: Option<f64>,
    /// Diameter of a disc, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diameter_m: Option<f64>,
    /// Whether a disc is lighter or darker than its surroundings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub brightness: Option<Brightness>,
    /// Colour of a disc, `#rrggbb`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub color: Option<String>,
    /// Centre in the vehicle frame, forward-right-down from the rear axle on the ground, metres.
    pub position_m: [f64; 3],
    /// Where the top of the printed tag points, degrees clockwise from vehicle forward.
    #[serde(default)]
    pub yaw_deg: f64,
}

fn one_cell() -> u8 {
    1
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes references")]
fn is_not(flag: &bool) -> bool {
    !flag
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes references")]
fn is_one_cell(border: &u8) -> bool {
    *border == 1
}

/// Kinds of marker.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MarkerKind {
    /// A square tag of the AprilTag families.
    Apriltag,
    /// A plain disc; two of different size or colour make a pair.
    Disc,
}

/// A disc against its surroundings.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Brightness {
    /// Lighter than its surroundings.
    Light,
    /// Darker than its surroundings.
    Dark,
}
