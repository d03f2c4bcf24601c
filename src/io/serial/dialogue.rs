//! A dialogue with a receiver before its line is read: send, and listen for a while.

use super::{Line, READ_BYTES, SerialSettings, left};
use crate::io::clock::HostClock;
use crate::io::device::{Fault, NoteKind, Report, Reports, wait_for};
use windhover_base::time::Span;

/// How long a receiver has to send something: it sends once a second, or answers at once.
const LISTEN: Span = Span::from_ns(1_500_000_000);

/// The line while its speed is settled.
pub(super) struct Dialogue<'a> {
    pub(super) line: &'a mut Line,
    pub(super) settings: &'a SerialSettings,
    pub(super) clock: HostClock,
    pub(super) reports: Reports<'a>,
}

impl Dialogue<'_> {
    pub(super) async fn send(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        self.line.write(bytes).await
    }

    /// Reads the line for a while; returns whether `enough` was satisfied.
    pub(super) async fn listen(&mut self, enough: impl Fn(&[u8]) -> bool + Send) -> Result<bool, Fault> {
        let limit = self.clock.now() + LISTEN;
        let (mut received, mut buffer) = (Vec::new(), vec![0; READ_BYTES]);
        loop {
            let read = wait_for(self.line.read(&mut buffer), self.reports);
            let Ok(read) = tokio::time::timeout(left(limit, self.clock), read).await else {
                return Ok(false);
            };
            received.extend_from_slice(&buffer[..read?]);
            if enough(&received) {
                return Ok(true);
            }
        }
    }

    /// Notifies the operator that something was, or was not, configured.
    pub(super) fn note(&self, is_done: bool, text: String) {
        let kind = if is_done { NoteKind::Configured } else { NoteKind::NotConfigured };
        (self.reports)(Report::Note(kind, 1, text));
    }
}
