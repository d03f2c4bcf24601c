//! `windhover detect IMAGE…`

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::{CliError, CliResult};
use crate::cli::out::{note, outln};
use crate::io::clock::HostClock;
use crate::pixels;
use crate::text::counted;
use windhover_base::msg::{GrayImage, TagFamily};
use windhover_detect::{Detector, LARGEST_IMAGE_PX, Limits, TagDetection, TagLayout};

/// Find markers in images.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover detect photo.png
  windhover detect --family 25h9 --min-px 12 --json *.jpg   # corners: top-left, top-right, bottom-right,
                                                            # bottom-left of the tag as printed")]
pub(super) struct Args {
    /// Images: PNG, JPEG, BMP, PNM or TIFF
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    /// Families of the tags, separated by commas
    #[arg(long, default_value = "36h11", value_delimiter = ',')]
    family: Vec<TagFamily>,
    /// Width of the border, cells: 1 as AprilTags are printed, 2 as Kalibr prints them
    #[arg(long, value_name = "CELLS", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=2))]
    border: u8,
    /// Tags whose left and right are exchanged: photographs of a mirror, or through the sheet's back
    #[arg(long)]
    mirrored: bool,
    /// Tags whose black and white are exchanged
    #[arg(long)]
    inverted: bool,
    /// Smallest edge of a tag's black square that is looked for, pixels
    #[arg(long, value_name = "N", default_value_t = 16.0, value_parser = min_px)]
    min_px: f64,
    /// Most wrong bits that are corrected; families with few bits correct fewer
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u8).range(0..=3))]
    max_hamming: u8,
    /// One JSON object for each image on standard output; its `ms` is the processor time of the detection
    #[arg(long)]
    json: bool,
}

fn min_px(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    (8.0..=10_000.0).contains(&value).then_some(value).ok_or_else(|| "not between 8 and 10000".to_owned())
}

pub(super) fn run(args: &Args) -> CliResult {
    let limits = Limits { min_px: args.min_px, max_hamming: args.max_hamming };
    let layouts: Vec<TagLayout> = layouts(args, (args.mirrored, args.inverted)).collect();
    let mut detector = Detector::new(&layouts, limits);
    let mut hints = Hints::new(args, limits);
    let mut failed = 0;
    for path in &args.images {
        let image = match read(path) {
            Ok(image) => image,
            Err(message) => {
                note!("windhover: {}: {message}", path.display());
                failed += 1;
                continue;
            }
        };
        let start = HostClock::thread_processor_time();
        let found = detector.detect(image.view());
        let ms = (HostClock::thread_processor_time() - start).ms();
        if args.json {
            outln!("{}", as_json(path, ms, found))?;
        } else {
            print_lines(path, ms, found)?;
        }
        if found.is_empty() {
            hints.look(path, &image);
        }
    }
    match failed {
        0 => Ok(()),
        n => {
            let all = counted(args.images.len(), "image");
            Err(CliError::failed(format!("{n} of {all} could not be read")))
        }
    }
}

/// The tags asked for, printed this way.
fn layouts(args: &Args, (mirrored, inverted): (bool, bool)) -> impl Iterator<Item = TagLayout> {
    let border = args.border;
    args.family.iter().map(move |&family| TagLayout { family, border, mirrored, inverted })
}

/// Where an image has no tag of those asked for, whether it has one that is mirrored or inverted.
struct Hints {
    /// The options that would read a tag, and a detector of such.
    ways: Vec<(&'static str, Detector)>,
}

impl Hints {
    fn new(args: &Args, limits: Limits) -> Self {
        let ways = [
            ("without --mirrored and --inverted", (false, false)),
            ("with --mirrored", (true, false)),
            ("with --inverted", (false, true)),
            ("with --mirrored --inverted", (true, true)),
        ];
        let others = ways.into_iter().filter(|(_, way)| *way != (args.mirrored, args.inverted));
        let ways = others.map(|(words, way)| {
            let layouts: Vec<TagLayout> = layouts(args, way).collect();
            (words, Detector::new(&layouts, limits))
        });
        Self { ways: ways.collect() }
    }

    fn look(&mut self, path: &Path, image: &GrayImage) {
        for (words, detector) in &mut self.ways {
            if let Some(tag) = detector.detect(image.view()).first() {
                let (path, family, id) = (path.display(), tag.family.name(), tag.id);
                note!("windhover: {path}: tag {id} of {family} would be found {words}");
                return;
            }
        }
    }
}

fn read(path: &Path) -> Result<GrayImage, String> {
    let bytes = std::fs::read(path).map_err(|e| e.to_string())?;
    let (image, missing) = pixels::picture(&bytes)?;
    if image.width.max(image.height) > LARGEST_IMAGE_PX {
        return Err(format!(
            "{}×{} is larger than {LARGEST_IMAGE_PX} pixels on a side; scale it down",
            image.width, image.height
        ));
    }
    if !missing.is_empty() {
        note!("windhover: {}: damaged: {} of it missing", path.display(), counted(missing.len(), "part"));
    }
    Ok(image)
}

fn as_json(path: &Path, ms: f64, found: &[TagDetection]) -> Value {
    let detections: Vec<Value> = found
        .iter()
        .map(|tag| {
            json!({
                "family": tag.family.name(),
                "id": tag.id,
                "hamming": tag.hamming,
                "margin": tag.margin,
                "center": [tag.center_px.x, tag.center_px.y],
                "corners": tag.corners_px.map(|c| [c.x, c.y]),
            })
        })
        .collect();
    json!({ "image": path.to_string_lossy(), "ms": ms, "detections": detections })
}

fn print_lines(path: &Path, ms: f64, found: &[TagDetection]) -> CliResult {
    outln!("{}: {} in {ms:.2} ms", path.display(), counted(found.len(), "tag"))?;
    for tag in found {
        outln!(
            "  {} {} at ({:.1}, {:.1}), {:.1} px, hamming {}, margin {:.0}",
            tag.family.name(),
            tag.id,
            tag.center_px.x,
            tag.center_px.y,
            tag.size_px,
            tag.hamming,
            tag.margin
        )?;
    }
    Ok(())
}
