//! Arbitrary images of any size, 1×1 upward: no panic, finite corners.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover_base::msg::{ImageView, TagFamily};
use windhover_detect::{Detector, Limits};

// The first three bytes select width, stride and smallest tag; the rest are pixels.
fuzz_target!(|data: &[u8]| {
    let [width, extra, min_px, pixels @ ..] = data else { return };
    let (width, extra) = (usize::from(*width) + 1, usize::from(*extra % 8));
    let stride = width + extra;
    let height = pixels.len() / stride;
    if height == 0 {
        return;
    }
    let view = ImageView { width, height, stride, data: pixels };
    let mut detector =
        Detector::new(&TagFamily::ALL, Limits { min_px: 8.0 + f64::from(min_px % 40), max_hamming: 3 });
    for tag in detector.detect(view) {
        assert!(tag.corners_px.iter().all(|c| c.iter().all(|x| x.is_finite())));
    }
});
