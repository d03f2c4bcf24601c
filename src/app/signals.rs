//! The signals that the daemon handles.

use tokio::signal::unix::{Signal, SignalKind, signal};

/// What a signal requests.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum SignalRequest {
    /// Stop; the signal's name.
    End(&'static str),
    /// Read the configuration again.
    Reload,
}

/// Receives signals from the time it is made; one that arrives while nothing waits is kept.
#[derive(Debug)]
pub struct Signals {
    terminate: Signal,
    interrupt: Signal,
    hang_up: Signal,
}

impl Signals {
    /// Takes over the signals; called on a runtime.
    pub fn new() -> std::io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            hang_up: signal(SignalKind::hangup())?,
        })
    }

    /// Waits for the next signal.
    pub async fn next(&mut self) -> SignalRequest {
        tokio::select! {
            Some(()) = self.terminate.recv() => SignalRequest::End("SIGTERM"),
            Some(()) = self.interrupt.recv() => SignalRequest::End("SIGINT"),
            Some(()) = self.hang_up.recv() => SignalRequest::Reload,
            else => std::future::pending().await,
        }
    }
}
