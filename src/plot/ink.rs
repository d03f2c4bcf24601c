//! Inks of a chart, by class.

/// What a mark is drawn with.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ink {
    /// First series.
    Blue,
    /// Second series.
    Orange,
    /// Third series.
    Green,
    /// Fourth series.
    Violet,
    /// What went wrong.
    Red,
    /// What is beside the point.
    Grey,
    /// Truth.
    Black,
}

impl Ink {
    /// Its class in the style sheet.
    pub const fn class(self) -> &'static str {
        match self {
            Self::Blue => "blue",
            Self::Orange => "orange",
            Self::Green => "green",
            Self::Violet => "violet",
            Self::Red => "red",
            Self::Grey => "grey",
            Self::Black => "black",
        }
    }
}
