//! Frames from another program over a Unix socket: a simulator, or a camera that V4L2 does not have.
//!
//! The other program listens at the path. Each frame is a header of 32 bytes, little-endian, and the pixels:
//!
//! | bytes | content |
//! |---|---|
//! | 0–3 | `WHF1` |
//! | 4–7 | four characters: `GREY`, `YUYV`, `UYVY`, `NV12`, `RGB3`, `BGR3`, `MJPG` |
//! | 8–15 | exposure, nanoseconds of CLOCK_MONOTONIC (i64) |
//! | 16–19, 20–23 | width and height, pixels (u32); 0 for `MJPG` |
//! | 24–27 | bytes from one row to the next (u32); 0 for `MJPG` |
//! | 28–31 | bytes of pixels that follow (u32) |

use std::sync::Arc;
use std::time::Duration;

use tokio::io::AsyncReadExt as _;
use tokio::net::UnixStream;

use crate::io::clock::HostClock;
use crate::io::device::{Fault, FaultKind, NoteKind, Report, Reports, wait_for};
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::{MonoTime, Span};

/// Bytes of a header, and its first bytes.
const HEADER: usize = 32;
const MAGIC: &[u8; 4] = b"WHF1";
/// Largest frame.
const LARGEST: usize = 64 << 20;
/// Longest time for the rest of a frame that has begun.
const STALLED: Duration = Duration::from_secs(2);
/// A stamp that is farther than this from its frame's arrival is invalid: the arrival replaces it.
const ODD: Span = Span::from_ns(2_000_000_000);

/// Takes frames until the other end closes, stalls or sends anything but a frame.
pub(super) async fn stream(
    path: &str,
    clock: HostClock,
    reports: Reports<'_>,
    delivered: &mut (dyn FnMut() + Send),
) -> Fault {
    let mut socket = match UnixStream::connect(path).await {
        Ok(socket) => socket,
        Err(error) => return refused(path, &error),
    };
    reports(Report::Up(format!("frames from socket {path}")));
    loop {
        let frame = match wait_for(next(&mut socket, path), reports).await {
            Ok(frame) => frame,
            Err(fault) => return fault,
        };
        let now = clock.now();
        let stamp_ns = frame.stamp_ns.saturating_add(clock.less_monotonic().ns());
        let age = Span::from_ns(now.ns().saturating_sub(stamp_ns));
        let odd = age > ODD || age < -ODD;
        if odd {
            let words = format!("{path}: a frame is stamped {:.1} s from its arrival", age.s());
            reports(Report::Note(NoteKind::StampsUnusable, 1, words));
        }
        let t_exposure = if odd { now } else { MonoTime::from_ns(stamp_ns) };
        reports(Report::Frame(now, FramePayload { t_exposure, ..frame.payload }));
        delivered();
    }
}

/// A frame and its stamp.
struct Sent {
    stamp_ns: i64,
    payload: FramePayload,
}

async fn next(socket: &mut UnixStream, path: &str) -> Result<Sent, Fault> {
    let lost = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::UnexpectedEof => {
            Fault::new(FaultKind::Unplugged, path, "the other end closed the connection")
        }
        _ => Fault::from_io(path, &error),
    };
    let stalled = |_| Fault::new(FaultKind::Frozen, path, "the other end stopped in the middle of a frame");
    let mut header = [0; HEADER];
    // The next frame may begin at any time; a frame that has begun must continue.
    socket.read_exact(&mut header[..1]).await.map_err(lost)?;
    let rest = tokio::time::timeout(STALLED, socket.read_exact(&mut header[1..])).await;
    rest.map_err(stalled)?.map_err(lost)?;
    let (mut sent, length) = parse(&header).map_err(|why| Fault::new(FaultKind::Unsuitable, path, why))?;
    let mut pixels = vec![0; length];
    let read = tokio::time::timeout(STALLED, socket.read_exact(&mut pixels)).await;
    read.map_err(stalled)?.map_err(lost)?;
    sent.payload.data = Arc::from(pixels);
    Ok(sent)
}

/// A header, and the number of bytes that follow it.
fn parse(header: &[u8; HEADER]) -> Result<(Sent, usize), String> {
    let word = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    if &header[..4] != MAGIC {
        return Err("the data are not a frame: a header begins with WHF1".into());
    }
    let code = &header[4..8];
    let (encoding, bits) = match code {
        b"GREY" => (FrameEncoding::Grey, 8),
        b"YUYV" => (FrameEncoding::Yuyv, 16),
        b"UYVY" => (FrameEncoding::Uyvy, 16),
        b"NV12" => (FrameEncoding::Nv12, 12),
        b"RGB3" => (FrameEncoding::Rgb24, 24),
        b"BGR3" => (FrameEncoding::Bgr24, 24),
        b"MJPG" => (FrameEncoding::Jpeg, 0),
        _ => return Err(format!("pixels of format {:?} are not supported", String::from_utf8_lossy(code))),
    };
    let (width, height, stride, length) = (word(16), word(20), word(24), word(28) as usize);
    let wanted = u64::from(width) * u64::from(height) * bits / 8;
    if length == 0 || length > LARGEST || (length as u64) < wanted {
        return Err(format!("a frame of {width} x {height} in {length} bytes is impossible"));
    }
    let mut stamp = [0; 8];
    stamp.copy_from_slice(&header[8..16]);
    let payload = FramePayload {
        index: 0,
        t_exposure: MonoTime::default(),
        encoding,
        width,
        height,
        stride,
        data: Arc::from([]),
    };
    Ok((Sent { stamp_ns: i64::from_le_bytes(stamp), payload }, length))
}

/// The header of a grey frame exposed at this reading of CLOCK_MONOTONIC.
pub fn grey_header(stamp_ns: i64, width: u32, height: u32) -> [u8; HEADER] {
    let mut header = [0; HEADER];
    header[..4].copy_from_slice(MAGIC);
    header[4..8].copy_from_slice(b"GREY");
    header[8..16].copy_from_slice(&stamp_ns.to_le_bytes());
    for (at, word) in [(16, width), (20, height), (24, width), (28, width * height)] {
        header[at..at + 4].copy_from_slice(&word.to_le_bytes());
    }
    header
}

fn refused(path: &str, error: &std::io::Error) -> Fault {
    match error.kind() {
        std::io::ErrorKind::ConnectionRefused => {
            Fault::new(FaultKind::Missing, path, "no program listens there; is the simulator running?")
        }
        _ => Fault::from_io(path, error),
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::AsyncWriteExt as _;
    use tokio::net::UnixListener;
    use tokio::sync::mpsc;

    use super::*;

    /// The camera's reports for the bytes that the other end sends, and its final fault.
    async fn received(sent: Vec<Vec<u8>>, stays: bool) -> (Vec<Report>, Fault) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("camera.sock").to_string_lossy().into_owned();
        let listener = UnixListener::bind(&path).expect("bound");
        let other_end = tokio::spawn(async move {
            let (mut socket, _) = listener.accept().await.expect("connected");
            for part in sent {
                let _ = socket.write_all(&part).await;
            }
            if stays {
                std::future::pending::<()>().await;
            }
        });
        let (sender, mut given) = mpsc::unbounded_channel();
        let reports = move |report| drop(sender.send(report));
        let fault = stream(&path, HostClock::start(), &reports, &mut || ()).await;
        other_end.abort();
        let mut all = Vec::new();
        while let Ok(report) = given.try_recv() {
            if !matches!(report, Report::Beat) {
                all.push(report);
            }
        }
        (all, fault)
    }

    fn frame(stamp_ns: i64) -> Vec<u8> {
        [grey_header(stamp_ns, 4, 2).as_slice(), &[7; 8]].concat()
    }

    #[tokio::test]
    async fn frames_come_with_their_stamps_and_odd_stamps_are_reported() {
        let clock = HostClock::start();
        let now = (clock.now() - clock.less_monotonic()).ns();
        let (reports, fault) = received(vec![frame(now), frame(now + 3_600_000_000_000)], false).await;
        let frames: Vec<_> = reports
            .iter()
            .filter_map(|report| if let Report::Frame(t, frame) = report { Some((*t, frame)) } else { None })
            .collect();
        assert_eq!((frames.len(), frames[0].1.data.len(), frames[0].1.stride), (2, 8, 4));
        assert!((frames[0].0 - frames[0].1.t_exposure).abs() < Span::from_ms(1_000.0));
        assert_eq!(frames[1].0, frames[1].1.t_exposure, "an hour ahead: the arrival replaces it");
        assert!(reports.iter().any(|r| matches!(r, Report::Note(NoteKind::StampsUnusable, ..))));
        assert_eq!(fault.kind, FaultKind::Unplugged);
    }

    #[tokio::test]
    async fn an_end_that_lies_or_stalls_is_left() {
        let mut odd = frame(0);
        odd[28..32].copy_from_slice(&u32::MAX.to_le_bytes());
        let mut short = frame(0);
        short[28..32].copy_from_slice(&7_u32.to_le_bytes());
        let mut foreign = frame(0);
        foreign[4..8].copy_from_slice(b"H264");
        for lie in [odd, short, foreign, b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n".to_vec()] {
            assert_eq!(received(vec![lie], true).await.1.kind, FaultKind::Unsuitable);
        }
        let (_, fault) = received(vec![frame(0)[..40 - 4].to_vec()], true).await;
        assert_eq!(fault.kind, FaultKind::Frozen);
        let nobody = stream("/nowhere/at/all", HostClock::start(), &|_| (), &mut || ()).await;
        assert_eq!(nobody.kind, FaultKind::Missing);
    }
}
