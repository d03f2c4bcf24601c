//! Common parts of the device tasks: reports, faults, waiting.

use std::cell::Cell;
use std::convert::Infallible;
use std::fmt;
use std::fs::File;
use std::io;
use std::ops::{Deref, DerefMut};
use std::os::fd::AsRawFd;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::time::Duration;

use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::task::spawn_blocking;

use windhover_base::msg::FramePayload;
use windhover_base::time::MonoTime;

/// Why a device does not deliver.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum FaultKind {
    /// The device does not exist (yet).
    Missing,
    /// Another program holds it.
    Busy,
    /// This user may not open it.
    Denied,
    /// It disappeared while in use.
    Unplugged,
    /// It exists and no longer delivers.
    Frozen,
    /// It cannot deliver the requested format or any other supported one.
    Unsuitable,
    /// Any other error of the system.
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

/// A device that does not deliver: which, why, and what the operator can do.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Fault {
    /// Why.
    pub kind: FaultKind,
    /// Path of the device, or its address.
    pub device: String,
    /// Information for the operator.
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

    /// The fault for an error of opening or using `device`. `EBUSY` and lock failures are [`FaultKind::Busy`], vanished
    /// devices [`FaultKind::Missing`].
    pub fn from_io(device: &str, error: &std::io::Error) -> Self {
        use rustix::io::Errno;
        let errno = error.raw_os_error().map(Errno::from_raw_os_error);
        let (kind, advice) = match errno {
            Some(Errno::NOENT | Errno::NXIO | Errno::NODEV) => {
                (FaultKind::Missing, "does not exist; is it plugged in?")
            }
            Some(Errno::BUSY) => (FaultKind::Busy, "another program uses it; stop that program"),
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
    /// The bytes that arrive do not fit the line's speed and format.
    Garbled,
    /// The driver's stamps cannot be used; arrival times replace them.
    StampsUnusable,
    /// The driver flagged a frame as damaged.
    FrameDamaged,
    /// The device delivers another format than requested, which is supported.
    FormatDiffers,
    /// The driver, or the line that triggers the camera, counted frames that did not come.
    FramesMissed,
    /// Exposure or gain were set as configured.
    ExposureSet,
    /// Exposure or gain could not be set as configured.
    ExposureNotSet,
    /// Frames arrive, and no pulses of the trigger.
    TriggerSilent,
    /// A receiver accepted its configuration.
    Configured,
    /// A receiver refused or ignored its configuration.
    NotConfigured,
    /// A note about the autopilot.
    Autopilot,
    /// A recorded source has played to its end.
    PlayedOut,
}

/// A report of a device task.
#[derive(Clone, Debug)]
pub enum Report {
    /// The device is open; the text describes it.
    Up(String),
    /// The bytes one read returned, and when it returned.
    Bytes(MonoTime, Vec<u8>),
    /// A frame, and when it was dequeued.
    Frame(MonoTime, FramePayload),
    /// The device does not deliver; it will be opened again.
    Down(Fault),
    /// A note about a device that delivers; `count` cases of this kind.
    Note(NoteKind, u32, String),
    /// A heartbeat of the task.
    Beat,
}

/// Where a device task's reports go. The call returns at once.
pub type Reports<'a> = &'a (dyn Fn(Report) + Sync);

/// Heartbeat period of a waiting task.
const BEAT: Duration = Duration::from_millis(250);

/// Waits for `ready`, with heartbeats meanwhile.
pub(super) async fn wait_for<T>(ready: impl Future<Output = T>, reports: Reports<'_>) -> T {
    let mut ready = std::pin::pin!(ready);
    loop {
        reports(Report::Beat);
        if let Ok(value) = tokio::time::timeout(BEAT, &mut ready).await {
            return value;
        }
    }
}

/// Runs blocking work on a thread for it. A panic of the work becomes a panic of the caller.
pub async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    match spawn_blocking(work).await {
        Ok(value) => value,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => resume_unwind(panic),
            // The runtime is shutting down: none of its tasks continues.
            Err(_) => std::future::pending().await,
        },
    }
}

thread_local! {
    static PANICS_CAUGHT: Cell<bool> = const { Cell::new(false) };
}

/// Whether a panic of this thread is caught, so that it is not a failure of the program.
pub fn panics_are_caught() -> bool {
    PANICS_CAUGHT.get()
}

/// Runs work in which a library may panic when a device disappears; `None` where it did.
pub(super) fn catch_panics<T>(work: impl FnOnce() -> T) -> Option<T> {
    let before = PANICS_CAUGHT.replace(true);
    let result = catch_unwind(AssertUnwindSafe(work));
    PANICS_CAUGHT.set(before);
    result.ok()
}

/// A device that owns its descriptor.
///
/// # Safety
///
/// `as_raw_fd` must return the same open descriptor for as long as the value lives.
pub(super) unsafe trait OwnsDescriptor: AsRawFd {}

// SAFETY: a file owns its descriptor and closes it when it is dropped.
unsafe impl OwnsDescriptor for File {}

/// Registers a device with the runtime for waiting.
pub(super) fn register<D: OwnsDescriptor>(device: D, interest: Interest) -> io::Result<AsyncFd<D>> {
    // SAFETY: `OwnsDescriptor` guarantees what is required, and the device lives as long as the returned value.
    Ok(unsafe { AsyncFd::register_with_interest(device, interest) }?)
}

/// An open device. Closing one can block (a line waits until its output is sent, a camera until its stream has ended)
/// and a driver's library may panic, so it is closed on a thread for blocking work, where a panic is caught.
#[derive(Debug)]
pub(super) struct Opened<T: Send + 'static>(Option<T>);

impl<T: Send + 'static> Opened<T> {
    pub(super) const fn new(device: T) -> Self {
        Self(Some(device))
    }

    /// The device itself.
    pub(super) fn into_inner(mut self) -> Option<T> {
        self.0.take()
    }

    /// Closes the device and waits until it is closed.
    pub(super) async fn close(mut self) {
        let device = self.0.take();
        blocking(move || close(device)).await;
    }
}

fn close<T>(device: T) {
    let _ = catch_panics(|| drop(device));
}

impl<T: Send + 'static> Deref for Opened<T> {
    type Target = T;

    fn deref(&self) -> &T {
        self.0.as_ref().expect("open until it is closed or dropped")
    }
}

impl<T: Send + 'static> DerefMut for Opened<T> {
    fn deref_mut(&mut self) -> &mut T {
        self.0.as_mut().expect("open until it is closed or dropped")
    }
}

impl<T: Send + 'static> Drop for Opened<T> {
    /// For a cancelled task: closes the device without waiting for it.
    fn drop(&mut self) {
        if let Some(device) = self.0.take() {
            spawn_blocking(move || close(device));
        }
    }
}

/// Pauses between attempts: a quarter of a second, doubled each time, five seconds at most.
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

    /// The device delivered: the next pause is short again.
    pub(super) fn reset(&mut self) {
        self.next = Self::FIRST;
    }

    /// Waits before the next attempt.
    pub(super) async fn wait(&mut self, reports: Reports<'_>) {
        wait_for(tokio::time::sleep(self.lengthen()), reports).await;
    }

    /// The next pause; the one after it is twice as long.
    fn lengthen(&mut self) -> Duration {
        let wait = self.next;
        self.next = (wait * 2).min(Self::LONGEST);
        wait
    }
}

/// Opens a line and watches it, without end: where it cannot be opened or is lost, this is reported and it is opened again after a
/// pause. `open` may block; `watch` gives the reason why the line is lost.
pub(super) async fn watch_line<T: Send + 'static, W: Future<Output = Fault>>(
    open: impl Fn() -> Result<T, Fault> + Clone + Send + 'static,
    watch: impl Fn(T) -> W,
    reports: Reports<'_>,
) -> Infallible {
    let mut backoff = Backoff::new();
    loop {
        let fault = match blocking(open.clone()).await {
            Ok(line) => {
                backoff.reset();
                watch(line).await
            }
            Err(fault) => fault,
        };
        reports(Report::Down(fault));
        backoff.wait(reports).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_distinguished() {
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
        let waits: Vec<Duration> = (0..7).map(|_| backoff.lengthen()).collect();
        assert!(waits.windows(2).all(|w| w[0] <= w[1]));
        assert_eq!((waits[0], waits[6]), (Backoff::FIRST, Backoff::LONGEST));
        backoff.reset();
        assert_eq!(backoff.lengthen(), Backoff::FIRST);
    }

    #[tokio::test]
    async fn a_device_is_closed_off_the_workers_and_its_panics_are_caught() {
        struct Device(std::sync::mpsc::Sender<std::thread::ThreadId>);
        impl Drop for Device {
            fn drop(&mut self) {
                let _ = self.0.send(std::thread::current().id());
                assert!(panics_are_caught());
                panic!("the driver failed");
            }
        }
        let (sender, closed) = std::sync::mpsc::channel();
        Opened::new(Device(sender.clone())).close().await;
        assert_ne!(closed.recv(), Ok(std::thread::current().id()));
        drop(Opened::new(Device(sender)));
        assert_ne!(closed.recv(), Ok(std::thread::current().id()));
        assert!(!panics_are_caught());
    }
}
