//! What every device thread has in common: what it tells, how it fails, how it waits before it tries again.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use windhover_base::msg::FramePayload;
use windhover_base::time::MonoTime;

/// Asks threads to end. Copies are the same switch.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Asks for the end.
    pub fn ask(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether the end was asked for.
    pub fn asked(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// Why a device does not deliver.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum FaultKind {
    /// There is no such device (yet).
    Missing,
    /// Another program holds it.
    Busy,
    /// This user may not open it.
    Denied,
    /// It went away while in use.
    Unplugged,
    /// It is there and delivers nothing any more.
    Frozen,
    /// It cannot give what was asked for, nor anything else understood.
    Unsuitable,
    /// Anything else the system says.
    Failed,
}

impl FaultKind {
    /// Its fixed name in logs.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Missing => "missing",
            Self::Busy => "busy",
            Self::Denied => "denied",
            Self::Unplugged => "unplugged",
            Self::Frozen => "frozen",
            Self::Unsuitable => "unsuitable",
            Self::Failed => "failed",
        }
    }
}

/// A device that does not deliver: which, why, and what to do about it.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Fault {
    /// Why.
    pub kind: FaultKind,
    /// Path of the device.
    pub device: String,
    /// What the operator should know or do.
    pub detail: String,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.device, self.detail)
    }
}

impl Fault {
    /// A fault of `device`.
    pub fn new(kind: FaultKind, device: &str, detail: impl Into<String>) -> Self {
        Self { kind, device: device.to_owned(), detail: detail.into() }
    }

    /// What an error of opening or using `device` means. `EBUSY` and lock failures are
    /// [`FaultKind::Busy`], vanished devices [`FaultKind::Missing`].
    pub fn from_io(device: &str, error: &std::io::Error) -> Self {
        use rustix::io::Errno;
        let errno = error.raw_os_error().map(Errno::from_raw_os_error);
        let (kind, advice) = match errno {
            Some(Errno::NOENT | Errno::NXIO | Errno::NODEV) => {
                (FaultKind::Missing, "not there; is it plugged in?")
            }
            Some(Errno::BUSY) => (FaultKind::Busy, "another program holds it; stop that program"),
            Some(Errno::ACCESS | Errno::PERM) => {
                (FaultKind::Denied, "permission denied; add this user to the device's group")
            }
            _ => return Self::new(FaultKind::Failed, device, error.to_string()),
        };
        Self::new(kind, device, advice)
    }
}

/// A note about a device that still delivers.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum NoteKind {
    /// What arrives is not what this line speed and format should give.
    Garbled,
    /// The driver's stamps cannot be used; arrival times stand in.
    StampsUnusable,
    /// The driver flagged a frame as damaged.
    FrameDamaged,
    /// The device gives another format than asked for, one that is understood.
    FormatDiffers,
    /// Frames the driver counted and never delivered.
    FramesMissed,
    /// A receiver was configured as asked.
    Configured,
    /// A receiver refused or ignored its configuration.
    NotConfigured,
    /// A recorded source has played to its end.
    PlayedOut,
}

/// What a device thread tells.
#[derive(Clone, Debug)]
pub enum Report {
    /// The device is open; the text says as what.
    Up(String),
    /// The bytes one read returned, and when it returned.
    Bytes(MonoTime, Vec<u8>),
    /// A frame, and when it was dequeued.
    Frame(MonoTime, FramePayload),
    /// The device does not deliver; it will be tried again.
    Down(Fault),
    /// Something to know about a device that delivers; `count` things of the kind.
    Note(NoteKind, u32, String),
    /// The thread is alive.
    Beat,
}

/// How long a thread sleeps at a time, so that it answers while it waits.
pub(super) const NAP: Duration = Duration::from_millis(100);

/// Waits between attempts: a quarter of a second, doubled each time, five seconds at most.
#[derive(Debug)]
pub(super) struct Backoff {
    next: Duration,
}

impl Backoff {
    const FIRST: Duration = Duration::from_millis(250);
    const LONGEST: Duration = Duration::from_secs(5);

    pub(super) const fn new() -> Self {
        Self { next: Self::FIRST }
    }

    /// The device delivered: the next wait is short again.
    pub(super) fn reset(&mut self) {
        self.next = Self::FIRST;
    }

    /// Waits in naps, answering, until the time is over or the end is asked for.
    pub(super) fn wait(&mut self, stop: &Stop, tell: &dyn Fn(Report)) {
        let mut left = self.next;
        self.next = (self.next * 2).min(Self::LONGEST);
        while !left.is_zero() && !stop.asked() {
            tell(Report::Beat);
            let nap = left.min(NAP);
            std::thread::sleep(nap);
            left -= nap;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_told_apart() {
        for (errno, kind) in [
            (rustix::io::Errno::NOENT, FaultKind::Missing),
            (rustix::io::Errno::BUSY, FaultKind::Busy),
            (rustix::io::Errno::ACCESS, FaultKind::Denied),
            (rustix::io::Errno::INVAL, FaultKind::Failed),
        ] {
            let error = std::io::Error::from_raw_os_error(errno.raw_os_error());
            assert_eq!(Fault::from_io("/dev/x", &error).kind, kind, "{errno}");
        }
    }

    #[test]
    fn waiting_grows_and_starts_again() {
        let mut backoff = Backoff::new();
        let stop = Stop::default();
        stop.ask();
        let waits: Vec<Duration> = (0..7)
            .map(|_| {
                let wait = backoff.next;
                backoff.wait(&stop, &|_| {});
                wait
            })
            .collect();
        assert!(waits.windows(2).all(|w| w[0] <= w[1]));
        assert_eq!(waits[6], Backoff::LONGEST);
        backoff.reset();
        assert_eq!(backoff.next, Backoff::FIRST);
    }
}
