//! What a tag looks like in print.

use super::family::{Cell, Family, TagLayout};

/// A tag as printed: white and black cells, the ring around its border included.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct TagPattern {
    /// Cells along an edge of the border, the square whose size is configured.
    pub border: usize,
    side: usize,
    white: Vec<bool>,
}

impl TagPattern {
    /// Cells on a side of the whole print.
    pub fn side(&self) -> usize {
        self.side
    }

    /// Whether the cell in column `x` and row `y` from the print's top-left is white; black outside.
    pub fn white(&self, x: usize, y: usize) -> bool {
        x < self.side && y < self.side && self.white[y * self.side + x]
    }
}

/// The print of a tag: of a family as its authors draw it, or of a layout with another border.
///
/// # Panics
/// Where the family has no tag of this number.
pub fn tag_pattern(layout: impl Into<TagLayout>, id: u32) -> TagPattern {
    let layout = layout.into();
    let tables = Family::new(layout, 0);
    let (side, pad) = (tables.grid_side(), tables.pad as i32);
    let last = tables.width as i32 - 1;
    let mut white: Vec<bool> = (0..side * side)
        .map(|i| {
            let (x, y) = ((i % side) as i32 - pad, (i / side) as i32 - pad);
            // The border is black in a white ring, or white in a black one.
            let in_square = (0..=last).contains(&x) && (0..=last).contains(&y);
            let is_free = matches!(tables.cell(id, x, y), Cell::Other);
            if is_free { !layout.inverted } else { in_square == tables.in_negative }
        })
        .collect();
    for (cell, (x, y)) in tables.cells.iter().enumerate() {
        white[(y + pad) as usize * side + (x + pad) as usize] = tables.bit(id, cell) != tables.in_negative;
    }
    TagPattern { border: tables.width, side, white }
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::msg::TagFamily;

    /// Families whose border is white in a black ring, as AprilTag 3 has them (`reversed_border`).
    const INVERTED: [TagFamily; 5] = [
        TagFamily::Tag41h12,
        TagFamily::Tag52h13,
        TagFamily::Tag48h12,
        TagFamily::Circle21h7,
        TagFamily::Circle49h12,
    ];

    #[test]
    fn borders_and_rings_have_their_colours() {
        for family in TagFamily::ALL {
            let pattern = tag_pattern(family, 3);
            let ring = (pattern.side() - pattern.border) / 2 - 1;
            let inverted = INVERTED.contains(&family);
            for k in 0..pattern.border {
                assert_eq!(pattern.white(ring + 1 + k, ring + 1), inverted, "{} border", family.name());
                assert_eq!(pattern.white(ring, ring + 1 + k), !inverted, "{} ring", family.name());
            }
        }
    }
}
