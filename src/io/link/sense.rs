//! Path information from the acknowledgements of a QUIC connection.
//!
//! QUIC's own congestion window is opened wide: a window that shrinks on loss would delay estimates on a lossy radio,
//! and one that fills during a cut would delay them after it. [`super::governor`] limits the rate instead, from the
//! round-trip times and losses noted here.

use std::any::Any;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use quinn::congestion::{Controller, ControllerFactory};

/// Wide enough to delay nothing; QUIC's pacer is inactive above 2³² bytes.
const WINDOW: u64 = 1 << 40;

/// Classes of packets by size, each of [`CLASS`] bytes: packets of up to 1280 bytes.
pub const CLASSES: usize = 20;
/// Bytes.
const CLASS: u64 = 64;

/// Acknowledgements and losses since the last [`Sense::take`].
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Noted {
    /// Bytes acknowledged.
    pub acked: u64,
    /// Bytes declared lost.
    pub lost: u64,
    /// Packets acknowledged.
    pub packets: u64,
    /// Least round-trip time among the acknowledged packets, by size.
    pub least_rtt: [Option<Duration>; CLASSES],
}

impl Noted {
    /// A packet was acknowledged this long after it was sent.
    pub fn acknowledge(&mut self, bytes: u64, rtt: Duration) {
        self.acked += bytes;
        self.packets += 1;
        let least = &mut self.least_rtt[((bytes / CLASS) as usize).min(CLASSES - 1)];
        *least = Some(least.map_or(rtt, |least| least.min(rtt)));
    }
}

/// Shared counters of one connection's path.
#[derive(Clone, Debug, Default)]
pub struct Sense(Arc<Mutex<Noted>>);

impl Sense {
    fn notes(&self) -> MutexGuard<'_, Noted> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Acknowledgements and losses since the last call.
    pub fn take(&self) -> Noted {
        std::mem::take(&mut *self.notes())
    }

    /// The counters of a connection's present path.
    pub fn of(connection: &quinn::Connection) -> Option<Self> {
        let controller = connection.congestion_state().into_any().downcast::<SenseController>().ok()?;
        Some(controller.sense)
    }
}

/// Makes a controller for each path.
#[derive(Debug, Default)]
pub struct SenseFactory;

impl ControllerFactory for SenseFactory {
    fn build(self: Arc<Self>, _now: Instant, _mtu: u16) -> Box<dyn Controller> {
        Box::new(SenseController::default())
    }
}

#[derive(Clone, Debug, Default)]
struct SenseController {
    sense: Sense,
}

impl Controller for SenseController {
    fn on_ack(
        &mut self,
        now: Instant,
        sent: Instant,
        bytes: u64,
        _app_limited: bool,
        _rtt: &quinn_proto::RttEstimator,
    ) {
        self.sense.notes().acknowledge(bytes, now.saturating_duration_since(sent));
    }

    fn on_congestion_event(&mut self, _now: Instant, _sent: Instant, _persistent: bool, lost: u64) {
        self.sense.notes().lost += lost;
    }

    fn on_mtu_update(&mut self, _mtu: u16) {}

    fn window(&self) -> u64 {
        WINDOW
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(self.clone())
    }

    fn initial_window(&self) -> u64 {
        WINDOW
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}
