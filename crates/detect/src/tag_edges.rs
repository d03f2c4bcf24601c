//! The edges between the cells of a decoded tag, and the widths of the cells beside them.

use super::edge_points::EdgePoint;
use super::family::Family;

/// Cells on a side of a block: edges so near each other have similar errors, because they share pixels.
const BLOCK: usize = 2;

/// Blocks of the largest grid.
pub(super) const MOST_BLOCKS: usize = 64;

/// How far the ground beside a tag is from the light of its ring towards the dark of its border: most ground reflects a
/// fifth to a half of the light, paper 85 %, ink 7 %.
const GROUND: f32 = 0.6;

/// Pixels from one point to the next along an edge, and most points of an edge.
const SPACING_PX: f64 = 1.4;
const MOST_POINTS: f64 = 8.0;

/// Points along every edge between cells of different colour; keeps its buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct TagEdges {
    /// On edges crossed along ξ, and along η.
    pub points: [Vec<EdgePoint>; 2],
    /// Whether the tag's cells, its ring included, are light, row by row, where that is known.
    lights: Vec<Option<bool>>,
}

impl TagEdges {
    /// Places the points of a tag whose cells are `cell` pixels wide.
    pub fn place(&mut self, family: &Family, id: u32, cell: f64) {
        self.points.iter_mut().for_each(Vec::clear);
        let w = family.width as i32;
        let per_cell = (cell / SPACING_PX).clamp(2.0, MOST_POINTS) as usize;
        self.lights.clear();
        let around = (-1..=w).flat_map(|y| (-1..=w).map(move |x| (x, y)));
        self.lights.extend(around.map(|(x, y)| family.is_light(id, x, y)));
        let scale = 2.0 / w as f32;
        let blocks = w as usize / BLOCK + 1;
        // Edges before cell x of row y, or where rows and columns change places, before row x of column y.
        for (y, x, axis) in (0..w).flat_map(|y| (0..=w).flat_map(move |x| [(y, x, 0), (y, x, 1)])) {
            let turned = |x: i32| if axis == 0 { (x, y) } else { (y, x) };
            let light = |x: i32| {
                let (x, y) = turned(x);
                self.lights[((y + 1) * (w + 2) + x + 1) as usize]
            };
            let (Some(before), Some(after)) = (light(x - 1), light(x)) else { continue };
            if before == after {
                continue;
            }
            // The distance in brightness of what is beyond a cell from the cell, relative to the other colour.
            let contrast = |beyond: i32, cell: bool| {
                let beyond = (-1..=w).contains(&beyond).then(|| light(beyond)).flatten();
                beyond.map_or(GROUND, |light| f32::from(u8::from(light != cell)))
            };
            let (far_before, far_after) = (contrast(x - 2, before), contrast(x + 1, after));
            let towards = if after { 1.0 } else { -1.0 };
            let narrow = towards * (far_before - far_after);
            let place = x as f32 * scale - 1.0;
            let block = {
                let (x, y) = turned(x);
                (x as usize / BLOCK * blocks + y as usize / BLOCK) as u8
            };
            for k in 0..per_cell {
                let along = (y as f32 + (k as f32 + 0.5) / per_cell as f32) * scale - 1.0;
                let (xi, eta) = if axis == 0 { (place, along) } else { (along, place) };
                self.points[axis].push(EdgePoint { xi, eta, light: towards, narrow, block });
            }
        }
    }

    /// How many points there are.
    pub fn count(&self) -> usize {
        self.points.iter().map(Vec::len).sum()
    }
}
