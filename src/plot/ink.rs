//! Colours of a chart, by class.

/// The colour of a mark.
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
    /// Failures.
    Red,
    /// Secondary data.
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
