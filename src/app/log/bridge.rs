//! Warnings of the libraries in use (QUIC, TLS, HTTP) become lines of the operator's log.

use std::fmt::{Debug, Write as _};

use tracing::field::{Field, Visit};
use tracing::{Level, Metadata, Subscriber};
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

use super::{Line, Log};
use crate::config::LogLevel;

/// Makes the log the destination of what libraries say. Later calls in one process change nothing.
pub(super) fn install(log: Log) {
    let _ = tracing_subscriber::registry().with(Bridge { log }).try_init();
}

struct Bridge {
    log: Log,
}

/// Libraries talk more than operators want to read: their information is our debugging.
fn level(metadata: &Metadata<'_>) -> LogLevel {
    let ours = metadata.target().starts_with("windhover");
    match *metadata.level() {
        Level::ERROR if ours => LogLevel::Error,
        Level::ERROR | Level::WARN => LogLevel::Warn,
        Level::INFO if ours => LogLevel::Info,
        Level::INFO => LogLevel::Debug,
        Level::DEBUG if ours => LogLevel::Debug,
        Level::DEBUG | Level::TRACE => LogLevel::Trace,
    }
}

impl<S: Subscriber> Layer<S> for Bridge {
    fn enabled(&self, metadata: &Metadata<'_>, _: Context<'_, S>) -> bool {
        self.log.shows(level(metadata))
    }

    fn on_event(&self, event: &tracing::Event<'_>, _: Context<'_, S>) {
        let metadata = event.metadata();
        let mut words = Words::default();
        event.record(&mut words);
        let mut line = Line::new(self.log.clock.now(), level(metadata), "library")
            .says(words.message)
            .with("about", metadata.target());
        line.fields.extend(words.fields.into_iter().map(|(name, text)| (name, text.into())));
        self.log.write(line);
    }
}

#[derive(Default)]
struct Words {
    message: String,
    fields: Vec<(String, String)>,
}

impl Visit for Words {
    fn record_str(&mut self, field: &Field, value: &str) {
        if field.name() == "message" {
            value.clone_into(&mut self.message);
        } else {
            self.fields.push((field.name().to_owned(), value.to_owned()));
        }
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        let mut text = String::new();
        // Writing to a string cannot fail.
        let _ = write!(text, "{value:?}");
        self.record_str(field, &text);
    }
}
