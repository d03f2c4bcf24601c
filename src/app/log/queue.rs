//! A sink's queue: bounded, and nothing waits for it. `tracing-appender` provides queue and thread; this module counts
//! the lines, and does not wait at the end for a stuck writer.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tracing_appender::non_blocking::{NonBlocking, NonBlockingBuilder, WorkerGuard};

use crate::io::clock::HostClock;
use windhover_base::time::MonoTime;

/// Most lines that wait to be written; further lines are dropped and counted.
const WAITING: usize = 512;

/// A sink's queue. Copies share the same queue.
#[derive(Clone)]
pub struct Queue {
    name: &'static str,
    queue: NonBlocking,
    counts: Arc<Counts>,
}

/// Ends the queue's thread when dropped, unless its writer is stuck: then the thread ends with the process.
pub struct QueueEnd {
    queue: Queue,
    guard: Option<WorkerGuard>,
}

/// Counts of lines by result.
#[derive(Default)]
struct Counts {
    put: AtomicU64,
    written: AtomicU64,
    refused: AtomicU64,
    /// Lost lines that were already reported.
    reported: AtomicU64,
}

/// A queue before a writer, which takes one whole line at each call.
pub fn queue(name: &'static str, writer: impl Write + Send + 'static) -> (Queue, QueueEnd) {
    let counts = Arc::new(Counts::default());
    let writer = Counted { writer, counts: counts.clone() };
    let builder = NonBlockingBuilder::default().lossy(true).buffered_lines_limit(WAITING);
    let (queue, guard) = builder.thread_name(name).finish(writer);
    let queue = Queue { name, queue, counts };
    (queue.clone(), QueueEnd { queue, guard: Some(guard) })
}

impl Queue {
    /// Name of the sink.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Puts a line, with its line end, into the queue, or drops it where that is full.
    pub fn put(&self, line: &[u8]) {
        self.counts.put.fetch_add(1, Ordering::Release);
        // A full queue counts the line; there is no other failure.
        let _ = self.queue.clone().write_all(line);
    }

    /// Lines dropped, or refused by the writer.
    fn lost(&self) -> u64 {
        let dropped = self.queue.error_counter().dropped_lines() as u64;
        dropped + self.counts.refused.load(Ordering::Acquire)
    }

    /// Lines in the queue and in the writer.
    pub fn waiting(&self) -> u64 {
        let done = self.counts.written.load(Ordering::Acquire) + self.lost();
        self.counts.put.load(Ordering::Acquire).saturating_sub(done)
    }

    /// Lines lost since the last call.
    pub fn newly_lost(&self) -> u64 {
        let lost = self.lost();
        lost - self.counts.reported.swap(lost, Ordering::AcqRel).min(lost)
    }

    /// Waits until everything is written or `limit` is over; returns how many lines are not written.
    pub fn drain(&self, clock: HostClock, limit: MonoTime) -> u64 {
        while self.waiting() > 0 && clock.now() < limit {
            std::thread::sleep(Duration::from_millis(2));
        }
        self.waiting()
    }
}

impl Drop for QueueEnd {
    fn drop(&mut self) {
        let guard = self.guard.take();
        if self.queue.waiting() > 0 {
            // The guard would wait for the writer, and print about it on standard output.
            std::mem::forget(guard);
        }
    }
}

/// A writer that counts lines.
struct Counted<W> {
    writer: W,
    counts: Arc<Counts>,
}

impl<W: Write> Write for Counted<W> {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let written = self.writer.write_all(line);
        let count = if written.is_ok() { &self.counts.written } else { &self.counts.refused };
        count.fetch_add(1, Ordering::Release);
        // The next line tries again.
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        // A failure has shown when the line was written.
        let _ = self.writer.flush();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::time::Span;

    #[test]
    fn a_pipe_that_nobody_reads_costs_its_own_lines_and_the_end_does_not_wait_for_it() {
        let clock = HostClock::start();
        let (reader, writer) = io::pipe().expect("a pipe");
        let (queue, end) = queue("stuck", writer);
        // A pipe takes 64 kB, the queue 512 lines, the writer holds one.
        let line = [[b'x'; 1023].as_slice(), b"\n"].concat();
        let before = clock.now();
        (0..1_000).for_each(|_| queue.put(&line));
        let waiting = queue.drain(clock, before + Span::from_ms(50.0));
        let lost = queue.newly_lost();
        assert_eq!(queue.newly_lost(), 0, "each loss is reported once");
        drop(end);
        assert!(clock.now() - before < Span::from_s(30.0), "nothing waits for the pipe");
        assert_eq!(lost + waiting + 64, 1_000);
        drop(reader);
    }

    #[test]
    fn lines_that_the_writer_refuses_are_counted() {
        let (reader, writer) = io::pipe().expect("a pipe");
        drop(reader);
        let (queue, _end) = queue("refused", writer);
        queue.put(b"one\n");
        let clock = HostClock::start();
        assert_eq!(queue.drain(clock, clock.now() + Span::from_s(20.0)), 0);
        assert_eq!(queue.newly_lost(), 1);
    }
}
