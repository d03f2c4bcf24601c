//! The reader for a video: a folder, Motion JPEG in AVI, Y4M, or ffmpeg for all others.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use std::process::{Command, Stdio};

use super::{Frames, ImportError, avi, folder, y4m};
use windhover_base::time::MonoTime;

/// How a video is read.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum VideoSource {
    /// A folder of images with `times.csv`: the times are its own.
    Folder,
    /// Motion JPEG in AVI: frames are stored unchanged.
    MotionJpeg,
    /// Y4M: luma is kept.
    Y4m,
    /// Any other, decoded by an installed ffmpeg.
    Ffmpeg,
}

/// Opens a video. `start` is the time of its first frame; a folder has its own times.
pub fn open_video(path: &Path, start: MonoTime) -> Result<(VideoSource, Frames), ImportError> {
    if path.is_dir() {
        return Ok((VideoSource::Folder, folder::open(path)?));
    }
    let io = |e| ImportError::io(path, e);
    let mut head = [0; 10];
    let mut file = File::open(path).map_err(io)?;
    let got = file.read(&mut head).map_err(io)?;
    if head[..got].starts_with(b"YUV4MPEG2") {
        let input = BufReader::new(File::open(path).map_err(io)?);
        return Ok((VideoSource::Y4m, y4m::frames(input, path, start)?));
    }
    if head[..got].starts_with(b"RIFF")
        && let Some(frames) = avi::open(path, start)?
    {
        return Ok((VideoSource::MotionJpeg, frames));
    }
    Ok((VideoSource::Ffmpeg, through_ffmpeg(path, start)?))
}

fn through_ffmpeg(path: &Path, start: MonoTime) -> Result<Frames, ImportError> {
    let child = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-i"])
        .arg(path)
        .args(["-f", "yuv4mpegpipe", "-pix_fmt", "gray", "-strict", "-1", "-"])
        .stdout(Stdio::piped())
        .stdin(Stdio::null())
        .spawn()
        .map_err(|error| {
            let reason = format!(
                "is neither Motion JPEG in AVI nor Y4M, and ffmpeg cannot be started ({error}): install it \
                 (apt install ffmpeg), or convert the video"
            );
            ImportError::video(path, reason)
        })?;
    let output = child.stdout.ok_or_else(|| ImportError::video(path, "ffmpeg gave no output"))?;
    y4m::frames(BufReader::new(output), path, start)
}
