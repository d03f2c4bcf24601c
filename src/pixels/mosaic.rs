//! Mosaics of colour filters (Bayer): grey levels with the mosaic filtered out, and colours.

use windhover_base::msg::{Bayer, GrayImage, RgbImage};

/// Rows of a frame's bytes.
pub(super) struct Rows<'a> {
    /// The bytes.
    pub(super) data: &'a [u8],
    /// Bytes from one row to the next.
    pub(super) stride: usize,
    /// Columns.
    pub(super) width: usize,
    /// Rows.
    pub(super) height: usize,
}

/// The index mirrored into `0..length` at its ends, so that its place in the mosaic's period is kept.
fn mirrored(index: isize, length: usize) -> usize {
    let last = length as isize - 1;
    let index = if index < 0 { -index } else { index };
    let index = if index > last { 2 * last - index } else { index };
    index.clamp(0, last) as usize
}

impl Rows<'_> {
    fn row(&self, v: isize) -> &[u8] {
        let start = mirrored(v, self.height) * self.stride;
        &self.data[start..start + self.width]
    }

    /// Grey: each pixel with its eight neighbours, weighted 1 2 1 | 2 4 2 | 1 2 1. For every filter of the pixel
    /// itself, red and blue have a quarter of the weight each and green a half, so that a uniform surface is uniform
    /// and an edge keeps its place.
    pub(super) fn grey(&self) -> GrayImage {
        let mut gray = GrayImage::new(self.width, self.height);
        let mut sums = vec![0_u32; self.width];
        for (v, out) in gray.data.chunks_exact_mut(self.width).enumerate() {
            let v = v as isize;
            let (above, own, below) = (self.row(v - 1), self.row(v), self.row(v + 1));
            let columns = above.iter().zip(own).zip(below);
            for (sum, ((a, o), b)) in sums.iter_mut().zip(columns) {
                *sum = u32::from(*a) + 2 * u32::from(*o) + u32::from(*b);
            }
            for (u, out) in out.iter_mut().enumerate() {
                let at = |u: isize| sums[mirrored(u, self.width)];
                let u = u as isize;
                *out = ((at(u - 1) + 2 * at(u) + at(u + 1) + 8) >> 4) as u8;
            }
        }
        gray
    }

    /// Colours: each pixel gets those of its cell of four. They serve to distinguish discs; nothing is measured in
    /// them.
    pub(super) fn colours(&self, order: Bayer) -> RgbImage {
        // Where red and blue are in the cell; green is in the two others.
        let (red, blue) = match order {
            Bayer::Rggb => ((0, 0), (1, 1)),
            Bayer::Bggr => ((1, 1), (0, 0)),
            Bayer::Gbrg => ((1, 0), (0, 1)),
            Bayer::Grbg => ((0, 1), (1, 0)),
        };
        let mut data = Vec::with_capacity(3 * self.width * self.height);
        for v in 0..self.height {
            for u in 0..self.width {
                let at = |(dv, du): (usize, usize)| {
                    let row = self.row(((v & !1) + dv) as isize);
                    u16::from(row[mirrored(((u & !1) + du) as isize, self.width)])
                };
                let green = (at((red.0, blue.1)) + at((blue.0, red.1))).div_ceil(2);
                data.extend([at(red) as u8, green as u8, at(blue) as u8]);
            }
        }
        RgbImage { width: self.width, height: self.height, data }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mosaic(order: Bayer, (r, g, b): (u8, u8, u8), width: usize, height: usize) -> Vec<u8> {
        let cell = match order {
            Bayer::Rggb => [[r, g], [g, b]],
            Bayer::Bggr => [[b, g], [g, r]],
            Bayer::Gbrg => [[g, b], [r, g]],
            Bayer::Grbg => [[g, r], [b, g]],
        };
        (0..height).flat_map(|v| (0..width).map(move |u| cell[v % 2][u % 2])).collect()
    }

    #[test]
    fn an_even_surface_is_even_in_every_order_to_its_edges() {
        for order in [Bayer::Rggb, Bayer::Bggr, Bayer::Gbrg, Bayer::Grbg] {
            for (width, height) in [(8, 6), (7, 5), (2, 2)] {
                let data = mosaic(order, (200, 100, 40), width, height);
                let rows = Rows { data: &data, stride: width, width, height };
                assert!(rows.grey().data.iter().all(|level| *level == 110), "{order:?} {width}x{height}");
                let colours = rows.colours(order).data;
                assert!(colours.chunks_exact(3).all(|p| p == [200, 100, 40]), "{order:?} {width}x{height}");
            }
        }
    }

    #[test]
    fn an_edge_stays_in_its_place() {
        // Grey light on a step between columns 5 and 6 looks the same in every filter.
        let data: Vec<u8> = (0..10).flat_map(|_| (0..12).map(|u| if u < 6 { 20 } else { 220 })).collect();
        let gray = Rows { data: &data, stride: 12, width: 12, height: 10 }.grey();
        assert_eq!(gray.data[24..36], [20, 20, 20, 20, 20, 70, 170, 220, 220, 220, 220, 220]);
    }
}
