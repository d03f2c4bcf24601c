//! Cameras that GStreamer opens: test pictures, files, an RTSP server of another author. `make test-gstreamer` installs what
//! they need.

use std::io::BufRead as _;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use windhover::io::camera::{CameraInputs, CameraSettings, ExposureSettings, run};
use windhover::io::clock::HostClock;
use windhover::io::device::{Fault, FaultKind, NoteKind, Report};
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::settings::PixelFormat;
use windhover_base::time::{MonoTime, Span};

/// A running camera.
struct Camera {
    reports: mpsc::UnboundedReceiver<Report>,
    /// While set, whoever takes a report needs 100 ms for it.
    slow: Arc<AtomicBool>,
    task: tokio::task::JoinHandle<()>,
}

impl Drop for Camera {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Camera {
    fn open(device: &str) -> Self {
        let (sender, reports) = mpsc::unbounded_channel();
        let slow = Arc::new(AtomicBool::new(false));
        let settings = CameraSettings {
            device: device.to_owned(),
            width: 320,
            height: 240,
            fps: 20.0,
            pixel_format: PixelFormat::Grey,
        };
        let wait = Arc::clone(&slow);
        let task = tokio::spawn(async move {
            let exposure = watch::Sender::new(ExposureSettings::default());
            let inputs = CameraInputs { exposure: exposure.subscribe(), trigger: None };
            let reports = move |report| {
                if wait.load(Ordering::Relaxed) && matches!(report, Report::Frame(..)) {
                    std::thread::sleep(Duration::from_millis(100));
                }
                drop(sender.send(report));
            };
            match run(&settings, &inputs, HostClock::start(), &reports).await {}
        });
        Self { reports, slow, task }
    }

    async fn next(&mut self) -> Report {
        let next = tokio::time::timeout(Duration::from_secs(30), async {
            loop {
                match self.reports.recv().await.expect("the camera's task runs") {
                    Report::Beat => {}
                    report => return report,
                }
            }
        });
        next.await.expect("a report within 30 s")
    }

    /// Frames until there are so many, with their times of arrival.
    async fn frames(&mut self, count: usize) -> Vec<(MonoTime, FramePayload)> {
        let mut frames = Vec::new();
        while frames.len() < count {
            match self.next().await {
                Report::Frame(t, frame) => frames.push((t, frame)),
                Report::Down(fault) => panic!("{fault}"),
                _ => {}
            }
        }
        frames
    }

    async fn fault(&mut self) -> Fault {
        loop {
            if let Report::Down(fault) = self.next().await {
                return fault;
            }
        }
    }
}

/// Intervals of stamps, milliseconds.
fn steps_ms(frames: &[(MonoTime, FramePayload)]) -> Vec<f64> {
    frames.windows(2).map(|pair| (pair[1].1.t_exposure - pair[0].1.t_exposure).ms()).collect()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[tokio::test(flavor = "multi_thread")]
async fn a_live_source_has_the_clocks_stamps_and_its_rows() {
    let mut camera = Camera::open(
        "gst:videotestsrc is-live=true pattern=white ! video/x-raw,format=GRAY8,width=321,height=240,framerate=25/1",
    );
    let up = camera.next().await;
    assert!(matches!(&up, Report::Up(text) if text.contains("321 × 240")), "{up:?}");
    let frames = camera.frames(60).await;
    // The source's own beat: every frame 40 ms after the one before, to the millisecond.
    assert!(steps_ms(&frames).iter().all(|step| (step - 40.0).abs() < 1.0), "{:?}", steps_ms(&frames));
    let ages: Vec<f64> = frames.iter().map(|(t, frame)| (*t - frame.t_exposure).ms()).collect();
    assert!(ages.iter().all(|age| *age > -1.0) && median(ages.clone()) < 50.0, "{ages:?}");
    let frame = &frames[0].1;
    assert_eq!(
        (frame.encoding, frame.width, frame.height, frame.stride),
        (FrameEncoding::Grey, 321, 240, 324)
    );
    assert_eq!(frame.data.len(), 324 * 240);
    assert!(frame.data.chunks(324).all(|row| row[..321].iter().all(|pixel| *pixel > 230)), "white");
}

#[tokio::test(flavor = "multi_thread")]
async fn luma_of_planes_and_jpeg_are_taken() {
    let planar =
        "videotestsrc is-live=true pattern=black ! video/x-raw,format=I420,width=64,height=48,framerate=50/1";
    let frames = Camera::open(&format!("gst:{planar}")).frames(3).await;
    assert_eq!((frames[0].1.encoding, frames[0].1.data.len()), (FrameEncoding::Grey, 64 * 48));
    assert!(frames[0].1.data.iter().all(|pixel| *pixel == 16), "black of video, no colours");
    let frames = Camera::open(&format!("gst:{planar} ! jpegenc")).frames(3).await;
    assert_eq!(frames[0].1.encoding, FrameEncoding::Jpeg);
    assert_eq!(frames[0].1.data[..2], [0xff, 0xd8]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_plays_at_its_own_pace_and_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("film.avi");
    let made = Command::new("gst-launch-1.0")
        .args(["-q", "videotestsrc", "num-buffers=20", "pattern=ball", "!"])
        .args([
            "video/x-raw,width=160,height=120,framerate=20/1",
            "!",
            "jpegenc",
            "!",
            "avimux",
            "!",
            "filesink",
        ])
        .arg(format!("location={}", file.display()))
        .status();
    assert!(made.is_ok_and(|status| status.success()), "gst-launch-1.0");
    let mut camera = Camera::open(&format!("gst:filesrc location={} ! decodebin", file.display()));
    for _ in 0..2 {
        let frames = camera.frames(20).await;
        assert!(steps_ms(&frames).iter().all(|step| (step - 50.0).abs() < 1.0), "{:?}", steps_ms(&frames));
        let took = (frames[19].0 - frames[0].0).ms();
        assert!((900.0..1_300.0).contains(&took), "{took} ms");
        let late = frames.iter().map(|(t, frame)| (*t - frame.t_exposure).ms());
        assert!(
            late.clone().all(|late| late > -5.0),
            "none before it is due: {:?}",
            late.collect::<Vec<_>>()
        );
        let ended = camera.fault().await;
        assert_eq!((ended.kind, ended.detail.as_str()), (FaultKind::Unplugged, "the stream ended"));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_opened_is_told_in_words() {
    for (device, kind, words) in [
        ("gst:nosuchelement", FaultKind::Missing, "nosuchelement"),
        ("gst:", FaultKind::Unsuitable, ""),
        ("gst:videotestsrc ! !", FaultKind::Unsuitable, ""),
        ("gst:filesrc location=/nowhere/at/all ! decodebin", FaultKind::Missing, "filesrc"),
        ("gst:videotestsrc ! video/x-raw,format=BGRx", FaultKind::Unsuitable, ""),
        ("gst:videotestsrc ! video/x-raw,format=GRAY8,width=20000,height=8", FaultKind::Unsuitable, "20000"),
        ("gst:audiotestsrc", FaultKind::Unsuitable, ""),
        ("rtsp://user:secret@127.0.0.1:1/none", FaultKind::Missing, ""),
    ] {
        let fault = Camera::open(device).fault().await;
        assert_eq!(fault.kind, kind, "{device}: {fault}");
        assert!(fault.detail.contains(words) && !fault.detail.is_empty(), "{device}: {fault}");
        assert!(!fault.to_string().contains("secret"), "{fault}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_that_nobody_takes_are_lost_and_counted() {
    let mut camera = Camera::open(
        "gst:videotestsrc is-live=true ! video/x-raw,format=GRAY8,width=64,height=48,framerate=100/1",
    );
    camera.frames(20).await;
    camera.slow.store(true, Ordering::Relaxed);
    let (mut stamps, mut lost) = (Vec::new(), 0);
    while stamps.len() < 30 {
        match camera.next().await {
            Report::Frame(_, frame) => stamps.push(frame.t_exposure),
            Report::Note(NoteKind::FramesMissed, count, _) => lost += count,
            _ => {}
        }
    }
    assert!(stamps.windows(2).all(|pair| pair[1] > pair[0]), "in order");
    let span = *stamps.last().expect("frames") - stamps[0];
    let expected = (span.ms() / 10.0).round() as u32 + 1;
    // All frames of the span came or were counted; those lost after the last note are not known yet.
    let known = 30 + lost;
    assert!(lost > 100 && known <= expected + 12 && known + 24 >= expected, "{known} of {expected}");
}

/// An RTSP server, killed at the end.
struct Server(Child);

impl Server {
    fn start(port: u16, codec: &str) -> Self {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/gstreamer/server.py");
        let mut child = Command::new("/usr/bin/python3")
            .args([script, &port.to_string(), codec])
            .stdout(Stdio::piped())
            .spawn()
            .expect("python3 starts");
        let mut line = String::new();
        let output = child.stdout.take().expect("a pipe");
        std::io::BufReader::new(output).read_line(&mut line).expect("a line");
        assert_eq!(line, "listening\n");
        Self(child)
    }

    fn signal(&self, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_child(&self.0);
        rustix::process::kill_process(pid, signal).expect("signalled");
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn free_port() -> u16 {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("bound");
    listener.local_addr().expect("an address").port()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_network_camera_is_watched_and_opened_again() {
    for codec in ["h264", "jpeg"] {
        let port = free_port();
        let server = Server::start(port, codec);
        let mut camera = Camera::open(&format!("rtsp://127.0.0.1:{port}/{codec}"));
        let frames = camera.frames(60).await;
        let last = &frames[20..];
        let steps = steps_ms(last);
        assert!(steps.iter().all(|step| *step > 0.0), "{codec}: in order: {steps:?}");
        assert!((median(steps.clone()) - 50.0).abs() < 5.0, "{codec}: {steps:?}");
        let ages: Vec<f64> = last.iter().map(|(t, frame)| (*t - frame.t_exposure).ms()).collect();
        assert!(ages.iter().all(|age| *age > -20.0) && median(ages.clone()) < 300.0, "{codec}: {ages:?}");
        assert_eq!((last[0].1.width, last[0].1.height), (320, 240), "{codec}");
        if codec == "h264" {
            // A camera that stalls.
            server.signal(rustix::process::Signal::STOP);
            let stalled = camera.fault().await;
            assert_eq!(stalled.kind, FaultKind::Frozen, "{stalled}");
            server.signal(rustix::process::Signal::CONT);
            camera.frames(20).await;
        }
        // A camera that is switched off and on.
        drop(server);
        let gone = camera.fault().await;
        assert!(!gone.detail.is_empty(), "{gone}");
        let _again = Server::start(port, codec);
        let mut reopened = Vec::new();
        while reopened.len() < 20 {
            if let Report::Frame(t, frame) = camera.next().await {
                reopened.push((t, frame));
            }
        }
        let apart = reopened[0].1.t_exposure - frames[59].1.t_exposure;
        assert!(apart > Span::from_ms(100.0), "{apart:?}");
    }
}
