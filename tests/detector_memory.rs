//! The tag detector takes no memory after its first frames: an allocator that counts.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use nalgebra::Vector2;
use windhover::config::TagFamily;
use windhover::detect::{Region, TagDetector, tag_pattern};
use windhover::msg::GrayImage;

/// Counts what the calling thread asks for.
struct Counting;

thread_local! {
    static ASKED: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: everything is handed on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ASKED.with(|n| n.set(n.get() + 1));
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ASKED.with(|n| n.set(n.get() + 1));
        // SAFETY: as the caller promises.
        unsafe { System.realloc(at, layout, size) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Speckled ground with two tags, one of them `at` a place of its own.
fn frame(at: usize) -> GrayImage {
    let mut image = GrayImage::new(640, 480);
    for (i, p) in image.data.iter_mut().enumerate() {
        *p = 90 + ((i % 640 / 3 * 31 + i / 640 / 3 * 57) % 61) as u8;
    }
    for (id, u, v, cell) in [(3, at, 100, 4), (7, 300, 200, 9)] {
        let pattern = tag_pattern(TagFamily::Tag36h11, id);
        for y in 0..pattern.side() * cell {
            for x in 0..pattern.side() * cell {
                image.data[(v + y) * 640 + u + x] = if pattern.white(x / cell, y / cell) { 210 } else { 25 };
            }
        }
    }
    image
}

#[test]
fn frames_after_the_first_take_no_memory() {
    let frames = [frame(60), frame(90), frame(120)];
    let mut detector = TagDetector::new(&[TagFamily::Tag36h11], 16.0, 2);
    let mut out = Vec::new();
    let mut pass = |detector: &mut TagDetector| {
        for image in &frames {
            out.clear();
            detector.detect(image.view(), &mut out);
            assert_eq!(out.len(), 2, "both tags are found");
            let region = Region::around(image.view(), Vector2::new(340.0, 240.0), 90.0).expect("inside");
            detector.detect_region(image.view(), region, &mut out);
            assert_eq!(out.len(), 3, "the region holds one of them");
        }
    };
    pass(&mut detector);
    let before = ASKED.with(Cell::get);
    assert!(before > 0, "the allocator counts");
    pass(&mut detector);
    assert_eq!(ASKED.with(Cell::get), before, "allocations in the second pass over the same frames");
}
