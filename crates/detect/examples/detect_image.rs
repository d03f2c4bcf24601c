//! The tags of image files: `cargo run --release -p windhover-detect --example detect_image -- photo.png …`

use std::error::Error;

use windhover_detect::{Detector, GrayImage, Limits, TagFamily};

fn main() -> Result<(), Box<dyn Error>> {
    let mut detector = Detector::new(&TagFamily::ALL, Limits::default());
    for path in std::env::args().skip(1) {
        let picture = image::open(&path)?.into_luma8();
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        let image = GrayImage::from_vec(width, height, picture.into_raw()).ok_or("not a whole picture")?;
        let found = detector.detect(image.view());
        println!("{path}: {} tags", found.len());
        for tag in found {
            println!("  {} {}, {} wrong bits", tag.family.name(), tag.id, tag.hamming);
            for (corner, cov) in tag.corners_px.iter().zip(&tag.corner_cov_px2) {
                let sigma = [cov[(0, 0)].sqrt(), cov[(1, 1)].sqrt()];
                println!("    ({:.2} ± {:.2}, {:.2} ± {:.2})", corner.x, sigma[0], corner.y, sigma[1]);
            }
        }
    }
    Ok(())
}
