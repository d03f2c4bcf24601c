//! Identifies the frame of the feed in each frame of a recorded flight: `hil_frames FLIGHT` prints
//! `frame,time_ns,number` rows; the number is read from the squares that `hil_feed` painted.

use std::path::Path;
use std::process::ExitCode;

use windhover::io::capture::CaptureReader;
use windhover::pixels;
use windhover_base::msg::{EventBody, ImageView};

fn main() -> ExitCode {
    let Some(flight) = std::env::args().nth(1) else {
        eprintln!("usage: hil_frames FLIGHT");
        return ExitCode::from(2);
    };
    let reader = match CaptureReader::open(Path::new(&flight)) {
        Ok(reader) => reader,
        Err(error) => {
            eprintln!("hil_frames: {error}");
            return ExitCode::FAILURE;
        }
    };
    println!("frame,time_ns,number");
    for event in reader.filter_map(|item| item.event) {
        let EventBody::Frame(frame) = event.body else { continue };
        let number = pixels::decode(&frame, false).ok().and_then(|decoded| number(&decoded.gray.view()));
        let number = number.map_or(String::new(), |number| number.to_string());
        println!("{},{},{number}", frame.index, frame.t_exposure.ns());
    }
    ExitCode::SUCCESS
}

/// The number in the top-left corner; `None` where a square is neither dark nor light, as in the driver's test picture
/// before the feed begins.
fn number(image: &ImageView<'_>) -> Option<u32> {
    (0..24u32).try_fold(0, |number, bit| {
        let square = image.crop(bit as usize * 8 + 2, 2, 4, 4);
        let sum: u32 = (0..square.height).flat_map(|v| square.row(v)).map(|&level| u32::from(level)).sum();
        match sum / 16 {
            0..=70 => Some(number),
            185..=255 => Some(number | 1 << bit),
            _ => None,
        }
    })
}
