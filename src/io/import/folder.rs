//! A folder of images with their times in `times.csv`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::{Frames, ImportError, parse_time};
use crate::io::regular;
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::MonoTime;

/// Size of the longest table that is read: a day at 30 Hz.
const LONGEST_TABLE: u64 = 1 << 28;
/// Size of the largest image file that is read: 16 384² grey levels.
const LARGEST_IMAGE: u64 = 1 << 28;

/// Opens a folder with `times.csv` (`time_s,file`, with or without that header).
pub(super) fn open(folder: &Path) -> Result<Frames, ImportError> {
    let table = folder.join("times.csv");
    let text = regular::read_text(&table, LONGEST_TABLE).map_err(|e| ImportError::io(&table, e))?;
    let mut frames = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || (index == 0 && line.starts_with("time")) {
            continue;
        }
        frames.push(row(&table, folder, index + 1, line)?);
    }
    frames.sort();
    let indexed = frames.into_iter().enumerate();
    Ok(Box::new(indexed.map(|(index, (t, file))| image(index as u32, t, &file))))
}

fn row(table: &Path, folder: &Path, number: usize, line: &str) -> Result<(MonoTime, PathBuf), ImportError> {
    let refused = || ImportError::line(table, number, "expected a time, a comma and the name of an image");
    let (time, file) = line.split_once(',').ok_or_else(refused)?;
    let t = parse_time(time.trim()).ok_or_else(refused)?;
    // The folder may come from another person: it may name its own images only, not other files of this machine.
    let file =
        regular::inside(folder, file.trim()).map_err(|e| ImportError::line(table, number, e.to_string()))?;
    Ok((t, file))
}

/// JPEG and PNG are stored unchanged; other formats are decoded and stored as grey levels.
fn image(index: u32, t: MonoTime, path: &Path) -> Result<FramePayload, ImportError> {
    let bytes = regular::read(path, LARGEST_IMAGE).map_err(|e| ImportError::io(path, e))?;
    let encoding = match image::guess_format(&bytes) {
        Ok(image::ImageFormat::Jpeg) => FrameEncoding::Jpeg,
        Ok(image::ImageFormat::Png) => FrameEncoding::Png,
        _ => {
            let gray = image::load_from_memory(&bytes)
                .map_err(|e| ImportError::video(path, format!("is not a readable image: {e}")))?
                .into_luma8();
            let (width, height) = gray.dimensions();
            return Ok(grey(index, t, width, height, gray.into_raw()));
        }
    };
    let data = Arc::from(bytes);
    Ok(FramePayload { index, t_exposure: t, encoding, width: 0, height: 0, stride: 0, data })
}

/// A frame of packed grey levels.
pub(super) fn grey(index: u32, t: MonoTime, width: u32, height: u32, data: Vec<u8>) -> FramePayload {
    let (encoding, data) = (FrameEncoding::Grey, Arc::from(data));
    FramePayload { index, t_exposure: t, encoding, width, height, stride: width, data }
}
