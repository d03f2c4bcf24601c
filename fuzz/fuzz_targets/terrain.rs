//! Arbitrary bytes as a terrain tile: a GeoTIFF, or the start of a `.hgt`; no panic, and a tile has heights everywhere.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use windhover::io::terrain;

fn read(path: &Path) {
    if let Ok(tile) = terrain::load(path) {
        assert!(tile.height_msl_m(30.0, -86.0).is_finite());
    }
}

fuzz_target!(|data: &[u8]| {
    windhover_fuzz::with_file("tif", &[data], read);
    windhover_fuzz::with_file("hgt", &[data], read);
});
