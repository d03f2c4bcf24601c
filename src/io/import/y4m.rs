//! YUV4MPEG2: the header's size and rate, then frames of planes; the luma plane is kept.

use std::io::{BufRead, Read};
use std::path::{Path, PathBuf};

use super::folder::grey;
use super::{Frames, ImportError};
use windhover_base::msg::FramePayload;
use windhover_base::time::{MonoTime, Span};

/// Longest header line accepted.
const HEADER_MAX: u64 = 4096;
/// Largest side accepted, pixels.
const SIDE_MAX: usize = 16_384;

struct Header {
    width: usize,
    height: usize,
    rate_hz: f64,
    /// Bytes of chroma after the luma plane.
    chroma: usize,
}

/// Frames of a Y4M stream; the first was taken at `start`.
pub(super) fn frames<R: BufRead + 'static>(
    mut input: R,
    path: &Path,
    start: MonoTime,
) -> Result<Frames, ImportError> {
    let header = read_header(&mut input, path)?;
    let mut reader = Reader { input, path: path.to_owned(), header, start, index: 0, ended: false };
    Ok(Box::new(std::iter::from_fn(move || reader.next_frame())))
}

fn read_line(input: &mut impl BufRead) -> std::io::Result<Vec<u8>> {
    let mut line = Vec::new();
    input.take(HEADER_MAX).read_until(b'\n', &mut line)?;
    Ok(line)
}

fn read_header(input: &mut impl BufRead, path: &Path) -> Result<Header, ImportError> {
    let refused = |reason: &str| ImportError::video(path, reason);
    let line = read_line(input).map_err(|e| ImportError::io(path, e))?;
    let text = String::from_utf8_lossy(&line);
    let mut words = text.split_ascii_whitespace();
    if words.next() != Some("YUV4MPEG2") {
        return Err(refused("is not a Y4M video: it does not begin with YUV4MPEG2"));
    }
    let (mut width, mut height, mut rate_hz, mut space) = (0, 0, None, "420");
    for word in words {
        let value = word.get(1..).unwrap_or("");
        match word.as_bytes()[0] {
            b'W' => width = value.parse().unwrap_or(0),
            b'H' => height = value.parse().unwrap_or(0),
            b'F' => rate_hz = rate(value),
            b'C' => space = value,
            _ => {}
        }
    }
    if width == 0 || height == 0 || width > SIDE_MAX || height > SIDE_MAX {
        return Err(refused("its Y4M header gives no valid size"));
    }
    let half = |n: usize| n.div_ceil(2);
    let chroma = match space {
        s if s.contains("p1") || s.contains("mono1") => return Err(refused("has more than 8 bits a sample")),
        s if s.starts_with("mono") => 0,
        s if s.starts_with("422") => 2 * half(width) * height,
        s if s.starts_with("444alpha") => 3 * width * height,
        s if s.starts_with("444") => 2 * width * height,
        s if s.starts_with("440") => 2 * width * half(height),
        s if s.starts_with("411") => 2 * width.div_ceil(4) * height,
        s if s.starts_with("410") => 2 * width.div_ceil(4) * height.div_ceil(4),
        s if s.starts_with("420") => 2 * half(width) * half(height),
        _ => {
            return Err(refused("has a chroma layout that is not supported; use 420, 422, 444, 411 or mono"));
        }
    };
    let rate_hz = rate_hz.ok_or_else(|| refused("its Y4M header gives no frame rate"))?;
    Ok(Header { width, height, rate_hz, chroma })
}

fn rate(text: &str) -> Option<f64> {
    let (n, d) = text.split_once(':')?;
    let rate = n.parse::<f64>().ok()? / d.parse::<f64>().ok()?;
    (rate.is_finite() && rate > 0.0).then_some(rate)
}

struct Reader<R> {
    input: R,
    path: PathBuf,
    header: Header,
    start: MonoTime,
    index: u32,
    ended: bool,
}

impl<R: BufRead> Reader<R> {
    fn next_frame(&mut self) -> Option<Result<FramePayload, ImportError>> {
        if self.ended {
            return None;
        }
        let frame = self.read_frame();
        self.ended = !matches!(frame, Ok(Some(_)));
        frame.transpose()
    }

    /// The luma of a frame; `None` where the file ends in it. Memory grows with the bytes that are there, not to the size that
    /// the header states.
    fn luma(&mut self) -> std::io::Result<Option<Vec<u8>>> {
        let (size, chroma) = ((self.header.width * self.header.height) as u64, self.header.chroma as u64);
        let mut luma = Vec::new();
        let read = self.input.by_ref().take(size).read_to_end(&mut luma)? as u64;
        let skipped = std::io::copy(&mut self.input.by_ref().take(chroma), &mut std::io::sink())?;
        Ok((read == size && skipped == chroma).then_some(luma))
    }

    /// A frame cut off at the end of the file ends the video.
    fn read_frame(&mut self) -> Result<Option<FramePayload>, ImportError> {
        let line = read_line(&mut self.input).map_err(|e| ImportError::io(&self.path, e))?;
        if line.is_empty() {
            return Ok(None);
        }
        if !line.starts_with(b"FRAME") {
            let reason = format!("is damaged after frame {}: no FRAME marker follows", self.index);
            return Err(ImportError::video(&self.path, reason));
        }
        let Header { width, height, rate_hz, .. } = self.header;
        let Some(luma) = self.luma().map_err(|e| ImportError::io(&self.path, e))? else { return Ok(None) };
        let t = self.start + Span::from_s(f64::from(self.index) / rate_hz);
        let frame = grey(self.index, t, width as u32, height as u32, luma);
        self.index = self.index.saturating_add(1);
        Ok(Some(frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn luma_is_found_in_every_layout() {
        // 5 by 3 pixels, so that halves and quarters are rounded up.
        let layouts = [
            ("420", 12),
            ("420jpeg", 12),
            ("420mpeg2", 12),
            ("420paldv", 12),
            ("422", 18),
            ("444", 30),
            ("444alpha", 45),
            ("440", 20),
            ("411", 12),
            ("410", 4),
            ("mono", 0),
        ];
        for (layout, chroma) in layouts {
            let mut video = format!("YUV4MPEG2 W5 H3 F30:1 Ip A1:1 C{layout}\n").into_bytes();
            for frame in 0..3u8 {
                video.extend_from_slice(b"FRAME\n");
                video.extend(std::iter::repeat_n(frame, 15));
                video.extend(std::iter::repeat_n(200, chroma));
            }
            let frames = frames(std::io::Cursor::new(video), Path::new("x.y4m"), MonoTime::default());
            let frames: Vec<_> = frames.expect("a header").collect();
            assert_eq!(frames.len(), 3, "{layout}");
            for (index, frame) in frames.into_iter().enumerate() {
                let frame = frame.expect("a frame");
                assert!(frame.data.iter().all(|level| usize::from(*level) == index), "{layout} {index}");
            }
        }
    }
}
