//! A sink: the layer that renders events as lines and passes them to its own queue or to a writer.

use std::io::Write;
use std::sync::{Mutex, PoisonError};

use tracing::{Event, Subscriber};
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::registry::LookupSpan;

use super::journal::{self, Journal};
use super::line::Line;
use super::queue::Queue;
use super::stream::Stream;
use crate::io::clock::HostClock;

/// The form of a line.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Format {
    /// logfmt.
    Text,
    /// One JSON object a line.
    Json,
    /// A datagram for the journal.
    Journal,
    /// Text for a terminal.
    Plain,
}

impl Format {
    fn render(self, line: &Line) -> Vec<u8> {
        let text = match self {
            Self::Text => line.text(),
            Self::Json => line.json(),
            Self::Plain => line.plain(),
            Self::Journal => return journal::datagram(line),
        };
        (text + "\n").into_bytes()
    }
}

/// Where lines go.
pub(super) enum Destination {
    /// A queue: nothing waits for it, and lines may be lost.
    Queue(Queue),
    /// A writer: the command waits for it, as for all that it prints.
    Direct(Mutex<Box<dyn Write + Send>>),
}

/// The layer.
pub(super) struct Sink {
    pub(super) format: Format,
    pub(super) way: Destination,
    pub(super) clock: HostClock,
}

impl<S> Layer<S> for Sink
where
    S: Subscriber + for<'span> LookupSpan<'span>,
{
    fn on_event(&self, event: &Event<'_>, context: Context<'_, S>) {
        let line = self.format.render(&Line::of(event, &context, self.clock));
        match &self.way {
            Destination::Queue(queue) => queue.put(&line),
            Destination::Direct(writer) => {
                let mut writer = writer.lock().unwrap_or_else(PoisonError::into_inner);
                // A line that cannot be printed is lost, as with everything that a command prints.
                let _ = writer.write_all(&line);
            }
        }
    }
}

/// Writes datagrams to the journal; those that it refuses go to standard error, without fields.
pub(super) struct JournalWriter(pub(super) Journal);

impl Write for JournalWriter {
    fn write(&mut self, datagram: &[u8]) -> std::io::Result<usize> {
        if self.0.send(datagram).is_err() {
            let message = datagram.strip_prefix(b"MESSAGE=").unwrap_or(datagram);
            let end = message.iter().position(|byte| *byte == b'\n').map_or(message.len(), |at| at + 1);
            Stream::Error.write_all(&message[..end])?;
        }
        Ok(datagram.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}
