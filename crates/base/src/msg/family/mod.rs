//! Families of square tags: their names, how their cells lie, and their code words.
//!
//! A family is a file of code words beside this one and a row in the table below.

use serde::{Deserialize, Serialize};

mod tag16h5;
mod tag25h9;
mod tag36h11;
mod tag41h12;

/// How the tags of a family are made.
///
/// A tag is a grid of unit cells. Its border, the square that is found in an image, is `border` cells on a
/// side; around it lies a ring of the other colour.
#[derive(Clone, Copy, Debug)]
pub struct FamilySpec {
    /// Name in configuration and files.
    pub name: &'static str,
    /// Cells of the border on a side.
    pub border: usize,
    /// Cells of the print around the border: 1, or 2 where data cells lie outside the ring.
    pub pad: usize,
    /// Whether the border is light and the ring dark.
    pub inverted: bool,
    /// Most wrong bits that may be corrected.
    ///
    /// With N codes of n bits, a random grid matches within h errors in one of four turns with probability
    /// about `4 N Σ C(n, k) / 2ⁿ`. The limits keep that below 2·10⁻⁴ save for 16h5, whose 2·10⁻³ at h = 0 is
    /// what its few bits allow.
    pub correctable: u8,
    /// Code word of each tag, data cells row by row, the first in the highest bit.
    pub codes: &'static [u64],
}

/// The enum, its list and the lookup of its specifications, out of one row a family.
macro_rules! families {
    ($($(#[$about:meta])* $variant:ident, $text:literal, $codes:ident,
       border $border:literal pad $pad:literal inverted $inverted:literal correctable $correctable:literal;)*) => {
        /// Families of square tags.
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default, Serialize, Deserialize)]
        pub enum TagFamily {
            $($(#[$about])* #[serde(rename = $text)] $variant,)*
        }

        impl TagFamily {
            /// Every family.
            pub const ALL: [Self; [$($text),*].len()] = [$(Self::$variant),*];

            /// How its tags are made.
            pub const fn spec(self) -> &'static FamilySpec {
                match self {
                    $(Self::$variant => {
                        static SPEC: FamilySpec = FamilySpec {
                            name: $text,
                            border: $border,
                            pad: $pad,
                            inverted: $inverted,
                            correctable: $correctable,
                            codes: &$codes::CODES,
                        };
                        &SPEC
                    })*
                }
            }
        }
    };
}

families! {
    /// 36 bits, 11 apart: 587 tags.
    #[default]
    Tag36h11, "36h11", tag36h11, border 8 pad 1 inverted false correctable 2;
    /// 25 bits, 9 apart: 35 tags.
    Tag25h9, "25h9", tag25h9, border 7 pad 1 inverted false correctable 1;
    /// 16 bits, 5 apart: 30 tags.
    Tag16h5, "16h5", tag16h5, border 6 pad 1 inverted false correctable 0;
    /// 41 bits, 12 apart, white border inside: 2115 tags.
    Tag41h12, "41h12", tag41h12, border 5 pad 2 inverted true correctable 3;
}

impl TagFamily {
    /// Its name in configuration and files.
    pub const fn name(self) -> &'static str {
        self.spec().name
    }

    /// How many tags it has.
    pub const fn codes(self) -> usize {
        self.spec().codes.len()
    }
}

impl std::str::FromStr for TagFamily {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        let known = Self::ALL.into_iter().find(|family| family.name() == name.trim_start_matches("tag"));
        known.ok_or_else(|| {
            format!("{name:?} is no tag family; known are {}", Self::ALL.map(Self::name).join(", "))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_family_is_known_by_its_name_and_has_codes_of_its_length() {
        for (family, bits, count) in [
            (TagFamily::Tag36h11, 36, 587),
            (TagFamily::Tag25h9, 25, 35),
            (TagFamily::Tag16h5, 16, 30),
            (TagFamily::Tag41h12, 41, 2115),
        ] {
            assert_eq!(family.name().parse(), Ok(family));
            assert_eq!(family.codes(), count);
            assert!(family.spec().codes.iter().all(|code| code >> bits == 0), "{}", family.name());
        }
        assert!("17h4".parse::<TagFamily>().is_err_and(|e| e.ends_with("36h11, 25h9, 16h5, 41h12")));
    }
}
