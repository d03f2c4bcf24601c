//! A recorded camera: the frames of a capture or a folder of images, delivered at their own pace.
//!
//! It replaces the device in tests and measurements: everything after the V4L2 call is the same.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;

use super::CameraSettings;
use crate::io::capture::CaptureReader;
use crate::io::clock::HostClock;
use crate::io::device::{Fault, FaultKind, NoteKind, Report, Reports, wait_for};
use windhover_base::msg::{EventBody, FrameEncoding, FramePayload};
use windhover_base::time::{MonoTime, Span};

/// Frames that wait for the task, as in a driver's buffers; with this many the player waits.
const WAITING: usize = 12;

/// After a frame was delivered, the next image is read after this share of a frame time.
const READ_AFTER: f64 = 0.25;

/// A recorded frame and when it was delivered, both on the recording's own clock.
struct Recorded {
    t_recv: MonoTime,
    frame: FramePayload,
}

/// A report of the player.
enum Played {
    /// The recording can be read.
    Opened,
    /// A frame that is due.
    Frame(FramePayload),
    /// The recording cannot be read.
    Unusable(Fault),
}

/// Delivers a recording's frames without end, or until it cannot be read. Reading files blocks, so a thread plays it,
/// as a driver does for a camera, and the task takes the frames.
pub(super) async fn play(
    path: &str,
    settings: &CameraSettings,
    again: bool,
    clock: HostClock,
    reports: Reports<'_>,
) -> Fault {
    let (delivered, mut frames) = mpsc::channel(WAITING);
    let frame_time = Span::from_s(1.0 / settings.fps);
    let player = Player { path: path.to_owned(), frame_time, again, clock, delivered };
    if let Err(error) = std::thread::Builder::new().name("recording".into()).spawn(move || player.run()) {
        return Fault::from_io(path, &error);
    }
    while let Some(played) = wait_for(frames.recv(), reports).await {
        match played {
            Played::Opened => reports(Report::Up(format!("recording {path}"))),
            Played::Frame(frame) => reports(Report::Frame(clock.now(), frame)),
            Played::Unusable(fault) => return fault,
        }
    }
    reports(Report::Note(NoteKind::PlayedOut, 1, format!("{path} has played to its end")));
    wait_for(std::future::pending(), reports).await
}

/// Plays a recording on its own thread, until its end or until nothing takes the frames.
struct Player {
    path: String,
    frame_time: Span,
    again: bool,
    clock: HostClock,
    delivered: mpsc::Sender<Played>,
}

impl Player {
    fn run(self) {
        if let Err(fault) = self.play() {
            let _ = self.delivered.blocking_send(Played::Unusable(fault));
        }
    }

    fn play(&self) -> Result<(), Fault> {
        let mut began = self.clock.now();
        let mut opened = false;
        loop {
            let frames = open(Path::new(&self.path))
                .map_err(|detail| Fault::new(FaultKind::Missing, &self.path, detail))?;
            if !std::mem::replace(&mut opened, true) && self.delivered.blocking_send(Played::Opened).is_err()
            {
                return Ok(());
            }
            let mut played = Span::ZERO;
            let mut first = None;
            for recorded in frames {
                let origin = *first.get_or_insert(recorded.t_recv);
                played = recorded.t_recv - origin;
                self.wait_until(began + played);
                let mut frame = recorded.frame;
                frame.t_exposure = began + (frame.t_exposure - origin);
                if self.delivered.blocking_send(Played::Frame(frame)).is_err() {
                    return Ok(());
                }
                // A driver takes no processor time from those who handle its frame; reading the next file does.
                self.wait_until(began + played + Span::from_s(self.frame_time.s() * READ_AFTER));
            }
            if first.is_none() {
                return Err(Fault::new(FaultKind::Unsuitable, &self.path, "has no camera frames"));
            }
            if !self.again {
                return Ok(());
            }
            began += played + self.frame_time;
        }
    }

    /// Sleeps until a frame is due.
    fn wait_until(&self, due: MonoTime) {
        if let Ok(left) = u64::try_from((due - self.clock.now()).ns()) {
            std::thread::sleep(Duration::from_nanos(left));
        }
    }
}

fn open(path: &Path) -> Result<Box<dyn Iterator<Item = Recorded>>, String> {
    if path.join(TIMES).is_file() {
        return Ok(Box::new(folder(path)?));
    }
    let reader = CaptureReader::open(path).map_err(|error| error.to_string())?;
    Ok(Box::new(reader.filter_map(|item| {
        let event = item.event?;
        let EventBody::Frame(frame) = event.body else { return None };
        Some(Recorded { t_recv: event.t_recv, frame })
    })))
}

/// The list of a folder's images: `time_s,file`, a row for each image, after a header row.
const TIMES: &str = "times.csv";

/// Images of a folder, in the order of its list; an image is read when it is due. Images that cannot be read are left
/// out.
fn folder(path: &Path) -> Result<impl Iterator<Item = Recorded> + use<>, String> {
    let list = path.join(TIMES);
    let text = std::fs::read_to_string(&list).map_err(|e| format!("cannot read {}: {e}", list.display()))?;
    let mut images: Vec<(MonoTime, PathBuf)> = Vec::new();
    for (number, line) in text.lines().enumerate().skip(1).filter(|(_, line)| !line.trim().is_empty()) {
        let (time, file) = line.split_once(',').unwrap_or((line, ""));
        let time: f64 = time
            .trim()
            .parse()
            .map_err(|_| format!("{}, line {}: {time:?} is not a time", list.display(), number + 1))?;
        images.push((MonoTime::from_ns(0) + Span::from_s(time), path.join(file.trim())));
    }
    Ok(images.into_iter().filter_map(|(t, file)| Some(Recorded { t_recv: t, frame: image(t, &file)? })))
}

/// An image file as a frame: PGM as raw grey, JPEG and PNG without conversion.
fn image(t_exposure: MonoTime, file: &Path) -> Option<FramePayload> {
    let data = std::fs::read(file).ok()?;
    let extension = file.extension()?.to_str()?.to_ascii_lowercase();
    let encoding = match extension.as_str() {
        "pgm" => {
            let (width, height, start) = pgm_header(&data)?;
            let pixels = data.get(start..start.checked_add(width as usize * height as usize)?)?;
            let data: Arc<[u8]> = Arc::from(pixels);
            let encoding = FrameEncoding::Grey;
            return Some(FramePayload { index: 0, t_exposure, encoding, width, height, stride: width, data });
        }
        "jpg" | "jpeg" => FrameEncoding::Jpeg,
        "png" => FrameEncoding::Png,
        _ => FrameEncoding::Unknown,
    };
    Some(FramePayload {
        index: 0,
        t_exposure,
        encoding,
        width: 0,
        height: 0,
        stride: 0,
        data: Arc::from(data),
    })
}

/// Width, height and first pixel of a binary 8-bit PGM (`P5`).
fn pgm_header(data: &[u8]) -> Option<(u32, u32, usize)> {
    let mut fields = Vec::new();
    let mut at = 0;
    while fields.len() < 4 {
        while data.get(at)?.is_ascii_whitespace() {
            at += 1;
        }
        let start = at;
        while !data.get(at)?.is_ascii_whitespace() {
            at += 1;
        }
        fields.push(std::str::from_utf8(&data[start..at]).ok()?);
    }
    let [magic, width, height, white] = fields.as_slice() else { return None };
    let known = *magic == "P5" && *white == "255";
    known.then_some((width.parse().ok()?, height.parse().ok()?, at + 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::settings::PixelFormat;

    #[tokio::test]
    async fn a_folder_plays_at_its_own_pace() {
        // Given three images 40 ms apart, the last of them missing.
        let folder = tempfile::tempdir().expect("a folder");
        let pgm = [b"P5\n4 2\n255\n".as_slice(), &[7; 8]].concat();
        std::fs::write(folder.path().join("a.pgm"), &pgm).expect("written");
        std::fs::write(folder.path().join("b.jpg"), [0xff, 0xd8]).expect("written");
        let list = "time_s,file\n100.00,a.pgm\n100.04,b.jpg\n100.08,c.jpg\n";
        std::fs::write(folder.path().join(TIMES), list).expect("written");

        // When it is played to its end.
        let settings = CameraSettings {
            device: String::new(),
            width: 4,
            height: 2,
            fps: 25.0,
            pixel_format: PixelFormat::Grey,
        };
        let (sender, mut given) = mpsc::unbounded_channel();
        let reports = move |report| drop(sender.send(report));
        let path = folder.path().to_string_lossy().into_owned();
        let mut frames = Vec::new();
        let taken = async {
            loop {
                match given.recv().await.expect("the task runs") {
                    Report::Frame(t, frame) => frames.push((t, frame)),
                    Report::Note(NoteKind::PlayedOut, ..) => break,
                    _ => {}
                }
            }
        };
        tokio::select! {
            () = taken => {}
            fault = play(&path, &settings, false, HostClock::start(), &reports) => panic!("{fault}"),
        }

        // Then two frames came, with the recorded interval between them.
        assert_eq!(frames.len(), 2);
        let apart = frames[1].1.t_exposure - frames[0].1.t_exposure;
        assert!((apart - Span::from_ms(40.0)).abs() < Span::from_ms(0.001), "{apart:?}");
        assert!(frames[1].0 >= frames[1].1.t_exposure);
        assert_eq!((frames[0].1.encoding, frames[0].1.data.len()), (FrameEncoding::Grey, 8));
        assert_eq!(frames[1].1.encoding, FrameEncoding::Jpeg);
    }

    #[test]
    fn what_is_no_recording_is_reported() {
        assert!(open(Path::new("/nowhere/at/all")).is_err());
        assert_eq!(pgm_header(b"P5 1280 1024 255\n..."), Some((1280, 1024, 17)));
        assert_eq!(pgm_header(b"P2 1 1 255\n0"), None);
        assert_eq!(pgm_header(b"P5 12"), None);
    }
}
