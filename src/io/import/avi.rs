//! Motion JPEG in AVI: the frame period from the main header, frames from the `movi` list.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::{Frames, ImportError};
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::{MonoTime, Span};

/// Largest frame accepted, bytes.
const FRAME_MAX: u32 = 1 << 28;

/// Frames of an AVI file; the first was taken at `start`. `Ok(None)` where it holds no Motion JPEG.
pub(super) fn open(path: &Path, start: MonoTime) -> Result<Option<Frames>, ImportError> {
    let io = |e| ImportError::io(path, e);
    let mut input = BufReader::new(File::open(path).map_err(io)?);
    let Some(period) = find_movi(&mut input).map_err(io)? else { return Ok(None) };
    let mut reader = Reader { input, path: path.to_owned(), period, start, index: 0 };
    let Some(first) = reader.next_frame() else { return Ok(None) };
    if matches!(&first, Ok(frame) if !frame.data.starts_with(&[0xff, 0xd8])) {
        return Ok(None);
    }
    let rest = std::iter::from_fn(move || reader.next_frame());
    Ok(Some(Box::new(std::iter::once(first).chain(rest))))
}

/// A chunk's four-character code and size; `None` at the end of the file.
fn chunk_head(input: &mut impl Read) -> std::io::Result<Option<([u8; 4], u32)>> {
    let mut head = [0; 8];
    match input.read_exact(&mut head) {
        Ok(()) => {}
        Err(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => return Ok(None),
        Err(e) => return Err(e),
    }
    let size = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
    Ok(Some(([head[0], head[1], head[2], head[3]], size)))
}

/// Moves the input to the first frame's chunk; returns the frame period.
fn find_movi(input: &mut (impl Read + Seek)) -> std::io::Result<Option<Span>> {
    let mut kind = [0; 4];
    match chunk_head(input)? {
        Some((code, _)) if &code == b"RIFF" => input.read_exact(&mut kind)?,
        _ => return Ok(None),
    }
    let mut period = None;
    while let Some((code, size)) = chunk_head(input)? {
        match &code {
            b"LIST" => {
                input.read_exact(&mut kind)?;
                match &kind {
                    b"movi" => return Ok(period),
                    b"hdrl" => {}
                    _ => skip(input, size.saturating_sub(4))?,
                }
            }
            b"avih" => {
                let mut microseconds = [0; 4];
                input.read_exact(&mut microseconds)?;
                period = Some(Span::from_ns(i64::from(u32::from_le_bytes(microseconds)) * 1_000))
                    .filter(|p| *p > Span::ZERO);
                skip(input, size.saturating_sub(4))?;
            }
            _ => skip(input, size)?,
        }
    }
    Ok(None)
}

/// Chunks are padded to even lengths.
fn skip(input: &mut impl Seek, size: u32) -> std::io::Result<()> {
    input.seek(SeekFrom::Current(i64::from(size) + i64::from(size & 1))).map(drop)
}

struct Reader {
    input: BufReader<File>,
    path: PathBuf,
    period: Span,
    start: MonoTime,
    index: u32,
}

impl Reader {
    fn next_frame(&mut self) -> Option<Result<FramePayload, ImportError>> {
        self.read_frame().map_err(|e| ImportError::io(&self.path, e)).transpose()
    }

    fn read_frame(&mut self) -> std::io::Result<Option<FramePayload>> {
        while let Some((code, size)) = chunk_head(&mut self.input)? {
            let is_video = code[2..] == *b"dc" || code[2..] == *b"db";
            if &code == b"LIST" {
                // `rec ` lists group frames: enter them.
                self.input.seek(SeekFrom::Current(4))?;
            } else if &code == b"idx1" || size > FRAME_MAX {
                return Ok(None);
            } else if is_video && size > 0 {
                // Grows with the bytes that are there, not to the length that is stated.
                let mut data = Vec::new();
                if self.input.by_ref().take(u64::from(size)).read_to_end(&mut data)? < size as usize {
                    return Ok(None);
                }
                if size & 1 == 1 {
                    self.input.seek(SeekFrom::Current(1))?;
                }
                return Ok(Some(self.frame(data)));
            } else {
                // An empty chunk repeats the frame before: a dropped frame, for which time passes.
                self.index = self.index.saturating_add(u32::from(is_video));
                skip(&mut self.input, size)?;
            }
        }
        Ok(None)
    }

    fn frame(&mut self, data: Vec<u8>) -> FramePayload {
        let index = self.index;
        self.index = self.index.saturating_add(1);
        FramePayload {
            index,
            t_exposure: self.start + Span::from_ns(self.period.ns().saturating_mul(i64::from(index))),
            encoding: FrameEncoding::Jpeg,
            width: 0,
            height: 0,
            stride: 0,
            data: Arc::from(data),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    #[test]
    fn a_length_and_a_period_that_cannot_be_end_the_video() {
        let mut file = tempfile::NamedTempFile::new().expect("a scratch file");
        let longest = FRAME_MAX.to_le_bytes();
        let frame = [b"00dc", &4u32.to_le_bytes()[..], &[0xff, 0xd8, 0xff, 0xd9]].concat();
        let cut = [b"00dc", &longest[..], &[0xff, 0xd8]].concat();
        file.write_all(&[frame, cut].concat()).expect("written");
        let input = BufReader::new(File::open(file.path()).expect("opened"));
        let period = Span::from_ns(i64::from(u32::MAX) * 1_000);
        let path = file.path().to_owned();
        let mut reader = Reader { input, path, period, start: MonoTime::default(), index: u32::MAX };
        let far = reader.next_frame().expect("a frame").expect("sound");
        assert_eq!((far.t_exposure, far.index), (MonoTime::from_ns(i64::MAX), u32::MAX));
        assert!(reader.next_frame().is_none());
    }
}
