//! Video's sink: each frame with what the pipeline said of it, for the thread that makes the film.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::app::film::is_of_film;
use crate::app::sink::{OutgoingRecord, Sink};
use crate::io::records::Record;
use windhover_base::msg::{Event, EventBody, FramePayload};
use windhover_base::time::{MonoTime, Span};

/// Records that wait while no frame is taken: some seconds of them.
const MOST_RECORDS: usize = 2_048;

/// What waits for the thread: the newest frame alone, and all records since the one before.
#[derive(Default)]
struct Waiting {
    records: VecDeque<Arc<Record>>,
    frame: Option<FramePayload>,
    dropped: u64,
}

/// Between the pipeline and the film's thread. Copies are the same.
#[derive(Clone, Default)]
pub struct VideoQueue(Arc<(Mutex<Waiting>, Condvar)>);

impl VideoQueue {
    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.0.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn record(&self, record: &Arc<Record>) {
        let mut waiting = self.waiting();
        if waiting.records.len() == MOST_RECORDS {
            waiting.records.pop_front();
        }
        waiting.records.push_back(Arc::clone(record));
    }

    /// A frame replaces one that still waits.
    fn frame(&self, frame: FramePayload) {
        let mut waiting = self.waiting();
        waiting.dropped += u64::from(waiting.frame.replace(frame).is_some());
        self.0.1.notify_one();
    }

    /// The next frame and the records before it; `None` where there is none within `patience`.
    pub fn take(&self, patience: Duration) -> Option<(FramePayload, VecDeque<Arc<Record>>)> {
        let (_, arrived) = &*self.0;
        let (mut waiting, _) = arrived
            .wait_timeout_while(self.waiting(), patience, |waiting| waiting.frame.is_none())
            .unwrap_or_else(PoisonError::into_inner);
        let frame = waiting.frame.take()?;
        Some((frame, std::mem::take(&mut waiting.records)))
    }

    /// Frames so far that the film's thread was too slow for.
    pub fn dropped(&self) -> u64 {
        self.waiting().dropped
    }
}

/// Gives frames, at most so many a second, when everything is said of them: at the event after theirs.
pub struct VideoSink {
    queue: VideoQueue,
    every: Span,
    held: Option<FramePayload>,
    due: Option<MonoTime>,
}

impl VideoSink {
    /// Into this queue, at most `rate_hz` frames a second.
    pub fn new(queue: VideoQueue, rate_hz: f64) -> Self {
        Self { queue, every: Span::from_s(1.0 / rate_hz), held: None, due: None }
    }

    /// Whether a frame of that time is sent. Stamps have jitter: a frame may be early by a quarter of the interval.
    fn is_due(&mut self, t: MonoTime) -> bool {
        let early = Span::from_ns(self.every.ns() / 4);
        let due = *self.due.get_or_insert(t);
        // After a pause, or where time went back, the beat begins anew.
        let in_step = t >= due - early && t - due < self.every;
        let stepped = t >= due + self.every || due - t > self.every + early;
        if in_step || stepped {
            self.due = Some(if in_step { due + self.every } else { t + self.every });
        }
        in_step || stepped
    }
}

impl Sink for VideoSink {
    fn event(&mut self, event: &Event) {
        if let Some(frame) = self.held.take() {
            self.queue.frame(frame);
        }
        if let EventBody::Frame(frame) = &event.body
            && self.is_due(frame.t_exposure)
        {
            self.held = Some(frame.clone());
        }
    }

    fn record(&mut self, record: &mut OutgoingRecord) {
        if is_of_film(&record.record.topic) {
            self.queue.record(&record.record);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::msg::FrameEncoding;

    fn frame(index: u32, t_ns: i64) -> Event {
        let t_exposure = MonoTime::from_ns(t_ns);
        let (width, height, stride, data) = (1, 1, 1, vec![0].into());
        let encoding = FrameEncoding::Grey;
        let body =
            EventBody::Frame(FramePayload { index, t_exposure, encoding, width, height, stride, data });
        Event { t_recv: t_exposure, seq: index.into(), body }
    }

    #[test]
    fn the_newest_frame_is_taken_when_all_is_said_of_it() {
        let queue = VideoQueue::default();
        let mut sink = VideoSink::new(queue.clone(), 100.0);
        sink.event(&frame(0, 0));
        assert!(queue.take(Duration::ZERO).is_none(), "its outputs are not there yet");
        (1..4).for_each(|k| sink.event(&frame(k, i64::from(k) * 10_000_000)));
        let (taken, _) = queue.take(Duration::ZERO).expect("a frame");
        assert_eq!((taken.index, queue.dropped()), (2, 2));
    }

    #[test]
    fn frames_are_thinned_to_the_rate_whatever_their_jitter() {
        for (camera_hz, rate_hz, expected) in [(30.0, 15.0, 150), (15.0, 15.0, 150), (25.0, 10.0, 100)] {
            let mut sink = VideoSink::new(VideoQueue::default(), rate_hz);
            let jitter = |k: i64| (k * 7_919 % 5 - 2) * 1_000_000;
            let times =
                (0..(10.0 * camera_hz) as i64).map(|k| (k as f64 * 1e9 / camera_hz) as i64 + jitter(k));
            let taken = times.filter(|t| sink.is_due(MonoTime::from_ns(*t))).count();
            assert!(taken.abs_diff(expected) <= 1, "{camera_hz} → {rate_hz}: {taken}");
        }
        let mut sink = VideoSink::new(VideoQueue::default(), 10.0);
        let taken = [0, 5_000_000_000, 1_000_000].map(|t| sink.is_due(MonoTime::from_ns(t)));
        assert_eq!(taken, [true, true, true], "a pause, and a clock that went back");
    }
}
