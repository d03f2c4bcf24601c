//! Images in memory.

/// An 8-bit grey image; row `v` starts at `v * stride`.
///
/// ```
/// use windhover_base::msg::GrayImage;
///
/// let image = GrayImage::from_vec(3, 2, vec![0, 1, 2, 10, 11, 12]).expect("three columns, two rows");
/// assert_eq!(image.view().crop(1, 0, 2, 2).row(1), [11, 12]);
/// assert!(GrayImage::from_vec(3, 2, vec![0; 5]).is_none());
/// ```
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct GrayImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pixels from one row to the next, at least `width`.
    pub stride: usize,
    /// `height * stride` pixels.
    pub data: Vec<u8>,
}

impl GrayImage {
    /// A black image.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, stride: width, data: vec![0; width * height] }
    }

    /// From packed rows; `None` where the size does not match.
    pub fn from_vec(width: usize, height: usize, data: Vec<u8>) -> Option<Self> {
        (data.len() == width.checked_mul(height)?).then_some(Self { width, height, stride: width, data })
    }

    /// A view of the whole image.
    pub fn view(&self) -> ImageView<'_> {
        ImageView { width: self.width, height: self.height, stride: self.stride, data: &self.data }
    }
}

/// A borrowed 8-bit grey image, or part of one.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct ImageView<'a> {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pixels from one row to the next.
    pub stride: usize,
    /// From the first pixel on; at least `(height − 1) * stride + width` long.
    pub data: &'a [u8],
}

impl<'a> ImageView<'a> {
    /// Row `v`, `width` pixels.
    pub fn row(&self, v: usize) -> &'a [u8] {
        &self.data[v * self.stride..v * self.stride + self.width]
    }

    /// The part that starts at (u, v), clipped to the image.
    pub fn crop(&self, u: usize, v: usize, width: usize, height: usize) -> ImageView<'a> {
        let (u, v) = (u.min(self.width), v.min(self.height));
        let width = width.min(self.width - u);
        let height = height.min(self.height - v);
        let start = (v * self.stride + u).min(self.data.len());
        ImageView { width, height, stride: self.stride, data: &self.data[start..] }
    }
}

/// A 24-bit RGB image, rows packed.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct RgbImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `3 * width * height` bytes, R first.
    pub data: Vec<u8>,
}
