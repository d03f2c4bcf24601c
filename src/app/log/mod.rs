//! The operator's log: the program's one `tracing` subscriber.
//!
//! ```text
//! app::events, app::health, libraries ─► throttle ─► level ─┬─► queue ─► standard error or journal
//!                                                           └─► queue ─► file
//! ```
//!
//! Each sink is a layer with its own queue and thread. A stuck sink loses its own lines, which are counted; it delays
//! neither the other sinks nor the end of the program.

mod file;
mod journal;
mod line;
mod queue;
mod sink;
mod span;
mod stream;
mod throttle;

pub use queue::{Queue, QueueEnd, queue};
pub use stream::{Stream, last_words};

use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use tracing::Subscriber;
use tracing::level_filters::LevelFilter;
use tracing_log::AsLog as _;
use tracing_subscriber::filter::{Targets, filter_fn};
use tracing_subscriber::layer::{Layer as _, SubscriberExt as _};
use tracing_subscriber::{Registry, reload};

use self::file::RotatingFile;
use self::journal::Journal;
use self::sink::{Destination, Format, JournalWriter, Sink};
use self::span::KeepSpanFields;
use self::throttle::Throttle;
use super::events::{self, TARGET};
use crate::config::{LogConfig, LogFormat, LogLevel};
use crate::io::clock::HostClock;
use windhover_base::time::Span;

/// Longest time that the sinks get, twice, at the end to write queued lines; a slower sink is abandoned. Together with
/// tasks and card this stays below the unit's `TimeoutStopSec`.
const ENDING: Span = Span::from_ns(400_000_000);

/// The changeable level.
type Level = reload::Handle<Targets, Registry>;

/// A handle on the log. Copies share the same log.
#[derive(Clone)]
pub struct Log {
    level: Level,
    reopen: Arc<AtomicBool>,
    queues: Vec<Queue>,
    clock: HostClock,
}

/// Ends the log when dropped: sinks that are not stuck write their queued lines first.
pub struct LogEnd {
    log: Log,
    /// Dropped after the wait.
    _ends: Vec<QueueEnd>,
}

/// Starts the daemon's log: throttled, to standard error or the journal, and to a file where one is configured.
pub fn start(config: &LogConfig, clock: HostClock) -> (Log, LogEnd) {
    let reopen = Arc::new(AtomicBool::new(false));
    let (screen, end) = screen(config.format);
    let format = if config.format == LogFormat::Json { Format::Json } else { Format::Text };
    let (mut queues, mut ends) = (vec![screen], vec![end]);
    if let Some(path) = &config.file {
        let limit_bytes = (config.file_mb * 1e6) as u64;
        let file = RotatingFile::new(Path::new(path), limit_bytes, config.files_kept, reopen.clone());
        let (queue, end) = queue("file", file);
        queues.push((format, queue));
        ends.push(end);
    }
    let sink = |(format, queue): &(Format, Queue)| Sink {
        format: *format,
        way: Destination::Queue(queue.clone()),
        clock,
    };
    let level = install(queues.iter().map(sink).collect(), config.level, Some(Throttle::new(clock)));
    let queues = queues.into_iter().map(|(_, queue)| queue).collect();
    let log = Log { level, reopen, queues, clock };
    (log.clone(), LogEnd { log, _ends: ends })
}

/// Starts the log of a command: messages alone, on standard error, and throttled, because other machines cause some of
/// them.
pub fn start_plain(clock: HostClock) -> LogEnd {
    let (queue, end) = queue("stderr", Stream::Error);
    let sink = Sink { format: Format::Plain, way: Destination::Queue(queue.clone()), clock };
    let level = install(vec![sink], LogLevel::Info, Some(Throttle::new(clock)));
    LogEnd { log: Log { level, reopen: Arc::default(), queues: vec![queue], clock }, _ends: vec![end] }
}

/// Starts the log of a command that prints lines while it runs and waits for its reader.
pub fn start_direct(writer: impl Write + Send + 'static, clock: HostClock) {
    let sink = Sink { format: Format::Text, way: Destination::Direct(Mutex::new(Box::new(writer))), clock };
    install(vec![sink], LogLevel::Info, None);
}

/// The sink for standard error.
fn screen(format: LogFormat) -> ((Format, Queue), QueueEnd) {
    let wanted = match format {
        LogFormat::Journal => true,
        LogFormat::Auto => journal::is_stderr(),
        LogFormat::Text | LogFormat::Json => false,
    };
    if let Some(journal) = wanted.then(|| Journal::open().ok()).flatten() {
        let (queue, end) = queue("journal", JournalWriter(journal));
        return ((Format::Journal, queue), end);
    }
    let (queue, end) = queue("stderr", Stream::Error);
    ((if format == LogFormat::Json { Format::Json } else { Format::Text }, queue), end)
}

/// Makes the layers the subscriber of this process; later calls change nothing.
fn install(sinks: Vec<Sink>, level: LogLevel, throttle: Option<Throttle>) -> Level {
    let (layers, handle) = layers(sinks, level, throttle);
    let _ = tracing::subscriber::set_global_default(layers);
    // Libraries that use the `log` crate.
    let _ = tracing_log::LogTracer::init();
    tracing_log::log::set_max_level(shown(level).1.as_log());
    handle
}

/// The throttle comes before the level: a row that ends another does so even where it is not shown.
fn layers(
    sinks: Vec<Sink>,
    level: LogLevel,
    throttle: Option<Throttle>,
) -> (impl Subscriber + Send + Sync, Level) {
    let (filter, handle) = reload::Layer::new(targets(level));
    let ours = || filter_fn(|metadata| metadata.target() == TARGET);
    let layers = tracing_subscriber::registry()
        .with(sinks.with_filter(filter))
        .with(throttle.map(|throttle| throttle.with_filter(ours())))
        .with(KeepSpanFields.with_filter(ours()));
    (layers, handle)
}

/// The levels that are shown: for our events this severity and higher, for libraries one step less, and no event of
/// theirs where only errors are shown.
const fn shown(level: LogLevel) -> (LevelFilter, LevelFilter) {
    match level {
        LogLevel::Error => (LevelFilter::ERROR, LevelFilter::OFF),
        LogLevel::Warn => (LevelFilter::WARN, LevelFilter::WARN),
        LogLevel::Info => (LevelFilter::INFO, LevelFilter::WARN),
        LogLevel::Debug => (LevelFilter::DEBUG, LevelFilter::INFO),
        LogLevel::Trace => (LevelFilter::TRACE, LevelFilter::TRACE),
    }
}

fn targets(level: LogLevel) -> Targets {
    let (ours, libraries) = shown(level);
    Targets::new().with_default(libraries).with_target(TARGET, ours)
}

impl Log {
    /// From now on shows lines of this severity and higher.
    pub fn set_level(&self, level: LogLevel) {
        // The subscriber lives as long as the process.
        let _ = self.level.reload(targets(level));
        tracing_log::log::set_max_level(shown(level).1.as_log());
    }

    /// Reopens the log file with its next line.
    pub fn reopen(&self) {
        self.reopen.store(true, Ordering::Release);
    }

    /// Emits how many lines each sink has lost since the last call, where any were lost.
    pub fn report_losses(&self) {
        for queue in &self.queues {
            match queue.newly_lost() {
                0 => {}
                lines => events::log_lines_lost(queue.name(), lines),
            }
        }
    }

    /// Waits a moment for queued lines to be written, and emits how many lines stuck sinks have lost.
    pub fn settle(&self) {
        let limit = self.clock.now() + ENDING;
        let waiting: Vec<u64> = self.queues.iter().map(|queue| queue.drain(self.clock, limit)).collect();
        for (queue, waiting) in self.queues.iter().zip(waiting) {
            match waiting + queue.newly_lost() {
                0 => {}
                lines => events::log_lines_lost(queue.name(), lines),
            }
        }
    }
}

impl Drop for LogEnd {
    fn drop(&mut self) {
        let limit = self.log.clock.now() + ENDING;
        for queue in &self.log.queues {
            queue.drain(self.log.clock, limit);
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use windhover_base::msg::{Notice, NoticeKind};
    use windhover_base::time::MonoTime;

    /// A writer whose text can be read.
    #[derive(Clone, Default)]
    struct Text(Arc<Mutex<Vec<u8>>>);

    impl Text {
        fn take(&self) -> String {
            let bytes = std::mem::take(&mut *self.0.lock().expect("not poisoned"));
            String::from_utf8(bytes).expect("UTF-8")
        }
    }

    impl Write for Text {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().expect("not poisoned").write(bytes)
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    fn sink(format: Format, text: &Text, clock: HostClock) -> Sink {
        Sink { format, way: Destination::Direct(Mutex::new(Box::new(text.clone()))), clock }
    }

    /// The lines of logfmt that `emit` makes, without a throttle.
    pub(in crate::app) fn lines_of(emit: impl FnOnce()) -> String {
        let (text, clock) = (Text::default(), HostClock::start());
        let (layers, _) = layers(vec![sink(Format::Text, &text, clock)], LogLevel::Info, None);
        tracing::subscriber::with_default(layers, emit);
        text.take()
    }

    #[test]
    fn every_sink_gets_the_same_line_and_what_was_held_back_is_counted() {
        let (first, second, clock) = (Text::default(), Text::default(), HostClock::start());
        let sinks = vec![sink(Format::Text, &first, clock), sink(Format::Text, &second, clock)];
        let (layers, _) = layers(sinks, LogLevel::Info, Some(Throttle::new(clock)));
        tracing::subscriber::with_default(layers, || {
            for s in [0, 1, 6] {
                events::notice(&Notice {
                    t: MonoTime::from_ns(1_795_014_245_501_000_000) + Span::from_s(f64::from(s)),
                    kind: NoticeKind::FrameUnusable,
                    source: Some(windhover_base::msg::Source::Camera),
                    target: None,
                    detail: "too short".into(),
                    misfit: None,
                });
            }
            events::OperatorEvent::Ready.emit("", "after 1.0 s");
        });
        let text = first.take();
        let lines: Vec<&str> = text.lines().collect();
        let line =
            "time=2026-11-18T15:04:05.501Z level=warn event=frame_unusable msg=\"too short\" about=camera";
        assert_eq!(lines[0], line);
        assert!(lines[1].starts_with("time=2026-11-18T15:04:11.501Z"), "{text}");
        assert!(lines[1].ends_with("about=camera more_like_it=1"), "{text}");
        assert!(
            lines[2].ends_with("level=info event=ready msg=\"after 1.0 s\"") && lines.len() == 3,
            "{text}"
        );
        assert_eq!(second.take(), text, "the time is the same, too");
    }

    #[test]
    fn the_level_changes_and_a_hidden_event_still_ends_another() {
        let (text, clock) = (Text::default(), HostClock::start());
        let sinks = vec![sink(Format::Text, &text, clock)];
        let (layers, level) = layers(sinks, LogLevel::Warn, Some(Throttle::new(clock)));
        tracing::subscriber::with_default(layers, || {
            use crate::io::device::{Fault, FaultKind};
            let fault = Fault::new(FaultKind::Missing, "/dev/gps", "not there");
            events::device_down("gps", &fault);
            events::device_down("gps", &fault);
            events::OperatorEvent::DeviceUp.emit("gps", "open");
            events::device_down("gps", &fault);
            let down = "level=warn event=device_down msg=\"/dev/gps: not there\" about=gps fault=missing";
            let lines = text.take();
            assert_eq!(lines.lines().filter(|line| line.ends_with(down)).count(), 2, "{lines}");
            assert_eq!(lines.lines().count(), 2, "{lines}");
            level.reload(targets(LogLevel::Info)).expect("the subscriber lives");
            events::OperatorEvent::DeviceUp.emit("gps", "open");
            assert!(text.take().ends_with("level=info event=device_up msg=open about=gps\n"));
        });
    }

    #[test]
    fn libraries_speak_through_the_same_subscriber_and_one_step_lower() {
        let _ = tracing_log::LogTracer::init();
        let text = lines_of(|| {
            tracing::error!(target: "quinn::endpoint", port = 5, "no socket");
            tracing_log::log::warn!(target: "sled::pagecache", "page of {} bytes", 7);
            tracing::info!(target: "quinn", "not for operators");
        });
        let lines: Vec<&str> = text.lines().map(|line| line.split_once(' ').expect("a time").1).collect();
        assert_eq!(
            lines,
            [
                "level=warn event=library msg=\"no socket\" about=quinn::endpoint port=5",
                "level=warn event=library msg=\"page of 7 bytes\" about=sled::pagecache",
            ]
        );
    }

    #[test]
    fn spans_carry_run_and_flight_to_who_asks_for_fields() {
        let (text, json, clock) = (Text::default(), Text::default(), HostClock::start());
        let sinks = vec![sink(Format::Text, &text, clock), sink(Format::Json, &json, clock)];
        let (layers, _) = layers(sinks, LogLevel::Error, None);
        tracing::subscriber::with_default(layers, || {
            let run = events::run_span(MonoTime::from_ns(1_795_014_245_501_000_000));
            run.in_scope(|| {
                events::flight("boot-7");
                events::flight("20261118T150407Z");
                events::OperatorEvent::TaskFailed.emit("gps", "ended by itself");
            });
        });
        assert!(text.take().ends_with("level=error event=task_failed msg=\"ended by itself\" about=gps\n"));
        let object: serde_json::Value = serde_json::from_str(&json.take()).expect("one object");
        assert_eq!(object["run"], "20261118T150405Z");
        assert_eq!(object["flight"], "20261118T150407Z");
    }
}
