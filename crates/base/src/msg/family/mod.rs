//! Families of square tags: their names, the layout of their cells, and their code words.
//!
//! A family is a file of code words beside this one and a row in the table below.

use serde::{Deserialize, Serialize};

mod aruco;
mod circle21h7;
mod circle49h12;
mod mip36h12;
mod tag16h5;
mod tag25h9;
mod tag36h11;
mod tag41h12;
mod tag48h12;
mod tag52h13;

/// Layout and code words of a family.
///
/// A tag is a grid of unit cells. Its border, the square that is detected in an image, is `border` cells on a side; a
/// ring of the other colour surrounds it.
#[derive(Clone, Copy, Debug)]
pub struct FamilySpec {
    /// Name in configuration and files.
    pub name: &'static str,
    /// Cells of the border on a side.
    pub border: usize,
    /// Cells of the print around the border: 1, or more where data cells are outside the ring.
    pub pad: usize,
    /// Which of the cells inside the border and outside the ring are data cells.
    pub form: Form,
    /// Whether the border is light and the ring dark.
    pub inverted: bool,
    /// Most wrong bits that may be corrected.
    ///
    /// With N codes of n bits, a random grid matches within h errors in one of four turns with probability about `4 N Σ
    /// C(n, k) / 2ⁿ`. The limits keep that below 2·10⁻⁴ except for 16h5, whose few bits allow no better than 2·10⁻³ at
    /// h = 0.
    pub correctable: u8,
    /// Code word of each tag, data cells row by row, the first in the highest bit.
    pub codes: &'static [u64],
}

/// Which of the cells inside the border and outside the ring are data cells.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Form {
    /// All of them.
    Square,
    /// All but four in the middle, where another tag may be.
    Nested,
    /// Those whose centre is in a circle: its squared radius in cells is that of the outermost row plus half a cell.
    Round,
}

/// Words of eight bytes, little-endian.
const fn words<const N: usize>(bytes: &[u8]) -> [u64; N] {
    let (chunks, mut words, mut k) = (bytes.as_chunks().0, [0; N], 0);
    while k < N {
        words[k] = u64::from_le_bytes(chunks[k]);
        k += 1;
    }
    words
}

/// The enum, its list and the lookup of its specifications, from one row for each family.
macro_rules! families {
    ($($(#[$about:meta])* $variant:ident, $text:literal, $codes:expr,
       $form:ident border $border:literal pad $pad:literal inverted $inverted:literal correctable $correctable:literal;)*) => {
        /// Families of square tags.
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default, Serialize, Deserialize)]
        pub enum TagFamily {
            $($(#[$about])* #[serde(rename = $text)] $variant,)*
        }

        impl TagFamily {
            /// Every family.
            pub const ALL: [Self; [$($text),*].len()] = [$(Self::$variant),*];

            /// Layout and code words of its tags.
            pub const fn spec(self) -> &'static FamilySpec {
                match self {
                    $(Self::$variant => {
                        static SPEC: FamilySpec = FamilySpec {
                            name: $text,
                            border: $border,
                            pad: $pad,
                            form: Form::$form,
                            inverted: $inverted,
                            correctable: $correctable,
                            codes: $codes,
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
    Tag36h11, "36h11", &tag36h11::CODES, Square border 8 pad 1 inverted false correctable 2;
    /// 25 bits, 9 apart: 35 tags.
    Tag25h9, "25h9", &tag25h9::CODES, Square border 7 pad 1 inverted false correctable 1;
    /// 16 bits, 5 apart: 30 tags.
    Tag16h5, "16h5", &tag16h5::CODES, Square border 6 pad 1 inverted false correctable 0;
    /// 41 bits, 12 apart, white border inside: 2115 tags.
    Tag41h12, "41h12", &tag41h12::CODES, Square border 5 pad 2 inverted true correctable 3;
    /// 52 bits, 13 apart, white border inside: 48 714 tags.
    Tag52h13, "52h13", &tag52h13::CODES, Square border 6 pad 2 inverted true correctable 3;
    /// 48 bits, 12 apart, white border inside, the middle left free for another tag: 42 211 tags.
    Tag48h12, "48h12", &tag48h12::CODES, Nested border 6 pad 2 inverted true correctable 3;
    /// 21 bits, 7 apart, round: 38 tags.
    Circle21h7, "circle21h7", &circle21h7::CODES, Round border 5 pad 2 inverted true correctable 0;
    /// 49 bits, 12 apart, round: 65 535 tags.
    Circle49h12, "circle49h12", &circle49h12::CODES, Round border 5 pad 3 inverted true correctable 3;
    /// ArUco, 36 bits, 12 apart: 250 tags.
    Mip36h12, "aruco_mip_36h12", &mip36h12::CODES, Square border 8 pad 1 inverted false correctable 3;
    /// ArUco of OpenCV, 16 bits: the first 50 tags.
    Aruco4x4N50, "aruco_4x4_50", aruco::CODES_4X4.split_at(50).0, Square border 6 pad 1 inverted false correctable 0;
    /// ArUco of OpenCV, 16 bits: the first 100 tags.
    Aruco4x4N100, "aruco_4x4_100", aruco::CODES_4X4.split_at(100).0, Square border 6 pad 1 inverted false correctable 0;
    /// ArUco of OpenCV, 16 bits: the first 250 tags.
    Aruco4x4N250, "aruco_4x4_250", aruco::CODES_4X4.split_at(250).0, Square border 6 pad 1 inverted false correctable 0;
    /// ArUco of OpenCV, 16 bits: 1000 tags.
    Aruco4x4N1000, "aruco_4x4_1000", aruco::CODES_4X4.split_at(1000).0, Square border 6 pad 1 inverted false correctable 0;
    /// ArUco of OpenCV, 25 bits: the first 50 tags.
    Aruco5x5N50, "aruco_5x5_50", aruco::CODES_5X5.split_at(50).0, Square border 7 pad 1 inverted false correctable 1;
    /// ArUco of OpenCV, 25 bits: the first 100 tags.
    Aruco5x5N100, "aruco_5x5_100", aruco::CODES_5X5.split_at(100).0, Square border 7 pad 1 inverted false correctable 0;
    /// ArUco of OpenCV, 25 bits: the first 250 tags.
    Aruco5x5N250, "aruco_5x5_250", aruco::CODES_5X5.split_at(250).0, Square border 7 pad 1 inverted false correctable 0;
    /// ArUco of OpenCV, 25 bits: 1000 tags.
    Aruco5x5N1000, "aruco_5x5_1000", aruco::CODES_5X5.split_at(1000).0, Square border 7 pad 1 inverted false correctable 0;
    /// ArUco of OpenCV, 36 bits: the first 50 tags.
    Aruco6x6N50, "aruco_6x6_50", aruco::CODES_6X6.split_at(50).0, Square border 8 pad 1 inverted false correctable 3;
    /// ArUco of OpenCV, 36 bits: the first 100 tags.
    Aruco6x6N100, "aruco_6x6_100", aruco::CODES_6X6.split_at(100).0, Square border 8 pad 1 inverted false correctable 3;
    /// ArUco of OpenCV, 36 bits: the first 250 tags.
    Aruco6x6N250, "aruco_6x6_250", aruco::CODES_6X6.split_at(250).0, Square border 8 pad 1 inverted false correctable 3;
    /// ArUco of OpenCV, 36 bits: 1000 tags.
    Aruco6x6N1000, "aruco_6x6_1000", aruco::CODES_6X6.split_at(1000).0, Square border 8 pad 1 inverted false correctable 2;
}

impl TagFamily {
    /// Its name in configuration and files.
    pub const fn name(self) -> &'static str {
        self.spec().name
    }

    /// Number of its tags.
    pub const fn codes(self) -> usize {
        self.spec().codes.len()
    }
}

impl std::str::FromStr for TagFamily {
    type Err = String;

    /// Names are also accepted in the form of AprilTag and OpenCV: `tagStandard41h12`, `DICT_4X4_50`. `4x4` means all
    /// tags of that size.
    fn from_str(name: &str) -> Result<Self, String> {
        let plain = |name: &str| {
            let name = name.to_ascii_lowercase().replace('_', "");
            let words = ["dict", "apriltag", "aruco", "tag", "standard", "custom", "circle"];
            words.iter().fold(name, |name, word| name.strip_prefix(word).unwrap_or(&name).to_owned())
        };
        let wanted = plain(name);
        let known = |wanted: &str| Self::ALL.into_iter().find(|family| plain(family.name()) == wanted);
        known(&wanted).or_else(|| known(&format!("{wanted}1000"))).ok_or_else(|| {
            format!("{name:?} is not a tag family; the families are {}", Self::ALL.map(Self::name).join(", "))
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
            (TagFamily::Tag52h13, 52, 48_714),
            (TagFamily::Tag48h12, 48, 42_211),
            (TagFamily::Circle21h7, 21, 38),
            (TagFamily::Circle49h12, 49, 65_535),
            (TagFamily::Mip36h12, 36, 250),
            (TagFamily::Aruco4x4N50, 16, 50),
            (TagFamily::Aruco5x5N250, 25, 250),
            (TagFamily::Aruco6x6N1000, 36, 1000),
        ] {
            assert_eq!(family.name().parse(), Ok(family));
            assert_eq!(family.codes(), count);
            assert!(family.spec().codes.iter().all(|code| code >> bits == 0), "{}", family.name());
        }
        assert!("17h4".parse::<TagFamily>().is_err_and(|e| e.contains("36h11, 25h9, 16h5, 41h12")));
        for (name, family) in [
            ("tagStandard52h13", TagFamily::Tag52h13),
            ("tagCustom48h12", TagFamily::Tag48h12),
            ("tagCircle21h7", TagFamily::Circle21h7),
            ("DICT_4X4_100", TagFamily::Aruco4x4N100),
            ("4x4_50", TagFamily::Aruco4x4N50),
            ("aruco_6x6_250", TagFamily::Aruco6x6N250),
            ("aruco_mip_36h12", TagFamily::Mip36h12),
            ("5x5", TagFamily::Aruco5x5N1000),
            ("DICT_ARUCO_MIP_36h12", TagFamily::Mip36h12),
            ("DICT_APRILTAG_36h11", TagFamily::Tag36h11),
        ] {
            assert_eq!(name.parse(), Ok(family), "{name}");
        }
    }
}
