//! What the service manager is told: ready, alive, stopping, reloading, and a line of status.

use std::time::Duration;

use sd_notify::NotifyState;

/// The service manager, where there is one. Without one every call does nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct ServiceManager;

impl ServiceManager {
    /// How often the watchdog is to be stroked: half of what the service manager allows; `None` where
    /// it does not watch this process.
    pub fn watchdog_period() -> Option<Duration> {
        sd_notify::watchdog_enabled().map(|limit| limit / 2)
    }

    /// Everything asked for is up.
    pub fn ready(self, status: &str) {
        self.send(&[NotifyState::Ready, NotifyState::Status(status)]);
    }

    /// Every task answers.
    pub fn alive(self) {
        self.send(&[NotifyState::Watchdog]);
    }

    /// One line on what goes on.
    pub fn status(self, status: &str) {
        self.send(&[NotifyState::Status(status)]);
    }

    /// The configuration is being read again; [`Self::ready`] ends it.
    pub fn reloading(self) {
        let stamp = NotifyState::monotonic_usec_now();
        match stamp {
            Ok(stamp) => self.send(&[NotifyState::Reloading, stamp]),
            Err(_) => self.send(&[NotifyState::Reloading]),
        }
    }

    /// The end has begun.
    pub fn stopping(self, status: &str) {
        self.send(&[NotifyState::Stopping, NotifyState::Status(status)]);
    }

    fn send(self, states: &[NotifyState<'_>]) {
        // A service manager that does not listen cannot be told so.
        let _ = sd_notify::notify(states);
    }
}
