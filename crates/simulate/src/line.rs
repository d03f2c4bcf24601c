//! A serial line: bytes at its speed, and the reads that receive them.

use std::collections::VecDeque;

use super::random::Stream;
use windhover_base::time::{MonoTime, Span};

/// Most bytes one read returns: a receive buffer is emptied when it fills or the line falls silent.
const MOST_BYTES: f64 = 32.0;
/// From a byte's arrival to the return of the read, ms: at least, and on average beyond that.
const WAKE_MS: (f64, f64) = (0.05, 0.10);

/// One direction of a serial line, 8N1.
#[derive(Clone, Debug)]
pub(super) struct Line {
    byte: Span,
    free_at: Option<MonoTime>,
    stream: Stream,
    reads: VecDeque<(MonoTime, Vec<u8>)>,
}

impl Line {
    pub(super) fn new(baud: u32, stream: Stream) -> Self {
        let byte = Span::from_s(10.0 / f64::from(baud.max(1)));
        Self { byte, free_at: None, stream, reads: VecDeque::new() }
    }

    /// Sends bytes the first of which begins at `t_first`, or as soon as the line is free.
    pub(super) fn send(&mut self, bytes: &[u8], t_first: MonoTime) {
        let begin = match self.free_at {
            Some(free) if free > t_first => free,
            _ => t_first,
        };
        let mut arrival = begin + self.byte;
        let mut rest = bytes;
        while !rest.is_empty() {
            let length = (self.stream.uniform(1.0, MOST_BYTES) as usize).min(rest.len());
            let (read, after) = rest.split_at(length);
            arrival += Span::from_ns(self.byte.ns() * (length as i64 - 1));
            let wake_ms = WAKE_MS.0 - WAKE_MS.1 * (1.0 - self.stream.uniform(0.0, 1.0)).ln();
            let mut t_read = arrival + Span::from_ms(wake_ms);
            if let Some((last, _)) = self.reads.back() {
                t_read = t_read.max(*last);
            }
            self.reads.push_back((t_read, read.to_vec()));
            arrival += self.byte;
            rest = after;
        }
        self.free_at = Some(arrival - self.byte);
    }

    /// When the next read returns.
    pub(super) fn next_at(&self) -> Option<MonoTime> {
        self.reads.front().map(|(t, _)| *t)
    }

    /// The next read.
    pub(super) fn pop(&mut self) -> Option<(MonoTime, Vec<u8>)> {
        self.reads.pop_front()
    }
}
