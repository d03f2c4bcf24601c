//! Notifications of the service manager: ready, alive, stopping, reloading, and a status line.

use std::time::Duration;

use sd_notify::NotifyState;

/// The service manager, where there is one. Without one every call does nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct ServiceManager;

impl ServiceManager {
    /// Period of watchdog notifications: half of the service manager's limit; `None` where it does not watch this
    /// process.
    pub fn watchdog_period() -> Option<Duration> {
        sd_notify::watchdog_enabled().map(|limit| limit / 2)
    }

    /// Every required part is up.
    pub fn ready(self, status: &str) {
        self.send(&[NotifyState::Ready, NotifyState::Status(status)]);
    }

    /// Every task answers.
    pub fn alive(self) {
        self.send(&[NotifyState::Watchdog]);
    }

    /// One line about the present state.
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

    /// The daemon is stopping.
    pub fn stopping(self, status: &str) {
        self.send(&[NotifyState::Stopping, NotifyState::Status(status)]);
    }

    fn send(self, states: &[NotifyState<'_>]) {
        // A failure to notify the service manager cannot be reported to it.
        let _ = sd_notify::notify(states);
    }
}
