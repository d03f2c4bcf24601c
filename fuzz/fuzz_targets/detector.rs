//! Any image of any size, 1×1 upward: no panic, finite corners.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover_base::msg::ImageView;
use windhover_base::msg::TagFamily;
use windhover_detect::TagDetector;

// The first three bytes choose width, stride and smallest tag; the rest are pixels.
fuzz_target!(|data: &[u8]| {
    let [width, extra, min_px, pixels @ ..] = data else { return };
    let (width, extra) = (usize::from(*width) + 1, usize::from(*extra % 8));
    let stride = width + extra;
    let height = pixels.len() / stride;
    if height == 0 {
        return;
    }
    let view = ImageView { width, height, stride, data: pixels };
    let mut detector = TagDetector::new(&TagFamily::ALL, 8.0 + f64::from(min_px % 40), 3);
    let mut found = Vec::new();
    detector.detect(view, &mut found);
    for tag in &found {
        let corners = tag.corners_px.expect("a tag has corners");
        assert!(corners.iter().all(|c| c.iter().all(|x| x.is_finite())));
    }
});
