//! Families of square tags.

use serde::{Deserialize, Serialize};

/// Families of square tags.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default, Serialize, Deserialize)]
pub enum TagFamily {
    /// 36 bits, 11 apart: 587 tags.
    #[default]
    #[serde(rename = "36h11")]
    Tag36h11,
    /// 25 bits, 9 apart: 35 tags.
    #[serde(rename = "25h9")]
    Tag25h9,
    /// 16 bits, 5 apart: 30 tags.
    #[serde(rename = "16h5")]
    Tag16h5,
    /// 41 bits, 12 apart, white border inside: 2115 tags.
    #[serde(rename = "41h12")]
    Tag41h12,
}

impl TagFamily {
    /// Every family.
    pub const ALL: [Self; 4] = [Self::Tag36h11, Self::Tag25h9, Self::Tag16h5, Self::Tag41h12];

    /// Its name in configuration and files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Tag36h11 => "36h11",
            Self::Tag25h9 => "25h9",
            Self::Tag16h5 => "16h5",
            Self::Tag41h12 => "41h12",
        }
    }

    /// How many tags it has.
    pub const fn codes(self) -> usize {
        match self {
            Self::Tag36h11 => 587,
            Self::Tag25h9 => 35,
            Self::Tag16h5 => 30,
            Self::Tag41h12 => 2115,
        }
    }
}

impl std::str::FromStr for TagFamily {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        let known = Self::ALL.into_iter().find(|family| family.name() == name.trim_start_matches("tag"));
        known.ok_or_else(|| format!("{name:?} is no tag family; known are 36h11, 25h9, 16h5, 41h12"))
    }
}
