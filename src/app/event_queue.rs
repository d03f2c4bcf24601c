//! The queue of events before the pipeline: bounded, in order of time; the oldest frame is dropped first.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use windhover_base::msg::{Event, EventBody, FramePayload, PerSource, Source};
use windhover_base::time::{MonoTime, Span};

/// Reads of the serial lines that can wait: more than ten seconds of them. A pipeline that is further behind does not
/// answer its heartbeat, and the watchdog restarts the daemon.
const READS: usize = 8192;

/// Most frames that wait while a pipeline catches up, and the longest time for it. After the computer stood still for
/// some hundred milliseconds (a disk, another program), everything arrives at once, and the pipeline handles it within
/// moments. If the queue is not empty within this time, the load is not a burst.
const BURST: usize = 16;
const CATCH_UP: Span = Span::from_ns(500_000_000);

/// Most bytes of the frames that wait, whatever their number: twenty 4K frames in colour.
const FRAME_BYTES: usize = 512 << 20;

/// A frame whose turn comes later than this after its arrival is dropped, so that estimates stay current.
const FRESH: Span = Span::from_ns(500_000_000);

/// A pipeline that has taken no frame for this time takes an older one, but none older than this.
const STARVING: Span = Span::from_ns(5_000_000_000);
const LATEST: Span = Span::from_ns(2_000_000_000);

/// What devices delivered and the pipeline has not yet taken.
///
/// Device tasks put events in, and the pipeline's thread takes them out; neither waits for the other. Channels of the
/// libraries do not drop their oldest message and report it, so the lanes are implemented here.
///
/// Events leave the queue numbered, in order of arrival, with times that never decrease. The recording holds exactly
/// what the pipeline handles, so it replays to the same estimates.
///
/// A pipeline that was busy with a frame finds the newest frames when it returns. From then on the oldest of these
/// stays next: if newer frames replaced it while the earlier reads are handled, a pipeline that is behind on reads
/// would never handle a frame. A frame whose turn still comes too late is dropped, and the pipeline handles reads until
/// it is current again: each frame that it handles while behind costs it the progress that it made.
///
/// All frames of a burst are kept. Only if the pipeline does not catch up, the oldest frames are dropped, until no more
/// wait than the queue's configured length.
#[derive(Debug)]
pub struct EventQueue {
    lanes: Mutex<Lanes>,
    filled: Condvar,
    frames: usize,
}

#[derive(Debug, Default)]
struct Lanes {
    reads: VecDeque<(MonoTime, EventBody)>,
    frames: VecDeque<(MonoTime, FramePayload)>,
    /// Whether the oldest frame is next, as soon as the reads before it are handled.
    pinned: bool,
    /// Whether lost frames were reported since the last frame.
    loss_reported: bool,
    /// Since when more frames wait than the configured length; reset when all are taken.
    crowded: Option<MonoTime>,
    /// Arrival of the newest event of any kind.
    newest: Option<MonoTime>,
    /// Arrival of the newest event when a frame was last taken.
    taken: Option<MonoTime>,
    dropped: PerSource<u32>,
    /// Whether the taker is to return at once.
    woken: bool,
    last: Option<MonoTime>,
    next_seq: u64,
    next_frame: u32,
}

impl EventQueue {
    /// A queue that holds this many frames for a pipeline that is behind.
    pub fn new(frames: usize) -> Self {
        Self { lanes: Mutex::default(), filled: Condvar::new(), frames: frames.max(1) }
    }

    /// Puts in bytes of a line, or that a source appeared or disappeared.
    pub fn put(&self, t_recv: MonoTime, body: EventBody) {
        let mut lanes = self.lock();
        if lanes.reads.len() >= READS
            && let Some((_, oldest)) = lanes.reads.pop_front()
            && let Some(source) = oldest.delivered_by()
        {
            lanes.dropped[source] += 1;
        }
        lanes.reads.push_back((t_recv, body));
        lanes.newest = lanes.newest.max(Some(t_recv));
        drop(lanes);
        self.filled.notify_one();
    }

    /// Puts in a frame; where too many wait, the oldest one that is not next is dropped.
    pub fn put_frame(&self, t_recv: MonoTime, frame: FramePayload) {
        let mut lanes = self.lock();
        lanes.frames.push_back((t_recv, frame));
        lanes.newest = lanes.newest.max(Some(t_recv));
        if lanes.frames.len() > self.frames {
            let since = *lanes.crowded.get_or_insert(t_recv);
            let most = if t_recv - since < CATCH_UP { self.frames.max(BURST) } else { self.frames };
            lanes.thin(|lanes| lanes.frames.len() > most);
        }
        lanes.thin(|lanes| {
            lanes.frames.iter().map(|(_, frame)| frame.data.len()).sum::<usize>() > FRAME_BYTES
        });
        drop(lanes);
        self.filled.notify_one();
    }

    /// The next event in order of time; `None` where none came for `patience`.
    pub fn take(&self, patience: Duration) -> Option<Event> {
        let mut lanes = self.lock();
        if lanes.is_empty() {
            let waiting = |lanes: &mut Lanes| lanes.is_empty() && !lanes.woken;
            let waited = self.filled.wait_timeout_while(lanes, patience, waiting);
            lanes = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        lanes.woken = false;
        lanes.next()
    }

    /// Makes [`Self::take`] return at once, now or at its next call.
    pub fn wake(&self) {
        self.lock().woken = true;
        self.filled.notify_one();
    }

    /// An event that the queue makes itself (a tick), numbered in order.
    pub fn number(&self, t: MonoTime, body: EventBody) -> Event {
        self.lock().number(t, body)
    }

    fn lock(&self) -> MutexGuard<'_, Lanes> {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Lanes {
    /// Drops the oldest frame that is not next while there are too many, down to the newest.
    fn thin(&mut self, too_many: impl Fn(&Self) -> bool) {
        let goes = usize::from(self.pinned);
        while self.frames.len() > goes + 1 && too_many(self) {
            self.frames.remove(goes);
            self.dropped[Source::Camera] += 1;
        }
    }

    fn is_empty(&self) -> bool {
        self.reads.is_empty() && self.frames.is_empty()
    }

    /// Whether a frame that arrived at `t` is too late.
    fn is_stale(&self, t: MonoTime) -> bool {
        let since = |earlier: MonoTime| self.newest.map_or(Span::ZERO, |newest| newest - earlier);
        let starving = self.taken.is_none_or(|taken| since(taken) >= STARVING);
        since(t) > if starving { LATEST } else { FRESH }
    }

    fn next(&mut self) -> Option<Event> {
        let read = self.reads.front().map(|(t, _)| *t);
        while let Some(&(t, _)) = self.frames.front()
            && read.is_none_or(|read| t < read)
            && self.is_stale(t)
        {
            self.frames.pop_front();
            self.dropped[Source::Camera] += 1;
        }
        self.next_in_order()
    }

    fn next_in_order(&mut self) -> Option<Event> {
        let read = self.reads.front().map(|(t, _)| *t);
        let frame = self.frames.front().map(|(t, _)| *t);
        let earliest = read.into_iter().chain(frame).min()?;
        let frame_is_next = frame.is_some_and(|t| read.is_none_or(|read| t < read));
        self.pinned = frame.is_some();
        // Losses are reported before the events that remain; lost frames together with the next frame, not one by one.
        let frames_due = frame.is_none() || (frame_is_next && !self.loss_reported);
        let due = |source: Source| source != Source::Camera || frames_due;
        let lost = Source::ALL.iter().copied().find(|&source| self.dropped[source] > 0 && due(source));
        if let Some(source) = lost {
            let count = std::mem::take(&mut self.dropped[source]);
            self.loss_reported |= source == Source::Camera;
            return Some(self.number(earliest, EventBody::Dropped { source, count }));
        }
        if frame_is_next {
            let (t, frame) = self.frames.pop_front()?;
            (self.pinned, self.loss_reported, self.taken) = (false, false, self.newest);
            if self.frames.is_empty() {
                self.crowded = None;
            }
            let index = self.next_frame;
            self.next_frame = index.wrapping_add(1);
            return Some(self.number(t, EventBody::Frame(FramePayload { index, ..frame })));
        }
        let (t, body) = self.reads.pop_front()?;
        Some(self.number(t, body))
    }

    fn number(&mut self, t: MonoTime, body: EventBody) -> Event {
        // Two threads may stamp and put in reverse order, microseconds apart. No two events share an instant, so a
        // recording sorted by time has this order.
        let t_recv = self.last.map_or(t, |last| t.max(last + Span::from_ns(1)));
        self.last = Some(t_recv);
        let seq = self.next_seq;
        self.next_seq += 1;
        Event { t_recv, seq, body }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use windhover_base::msg::FrameEncoding;

    fn at(ms: i64) -> MonoTime {
        MonoTime::from_ns(ms * 1_000_000)
    }

    fn frame(ms: i64) -> FramePayload {
        FramePayload {
            index: 0,
            t_exposure: at(ms),
            encoding: FrameEncoding::Grey,
            width: 1,
            height: 1,
            stride: 1,
            data: Arc::from([0u8].as_slice()),
        }
    }

    fn drain(queue: &EventQueue) -> Vec<Event> {
        std::iter::from_fn(|| queue.take(Duration::ZERO)).collect()
    }

    #[test]
    fn events_leave_in_order_of_time_and_never_go_back() {
        let queue = EventQueue::new(3);
        queue.put_frame(at(20), frame(15));
        queue.put(at(10), EventBody::Bytes { source: Source::Gps, data: vec![1] });
        queue.put(at(30), EventBody::Bytes { source: Source::Compass, data: vec![2] });
        let first = drain(&queue);
        queue.put(at(25), EventBody::Bytes { source: Source::Gps, data: vec![3] });
        let late = drain(&queue);
        let times: Vec<i64> = first.iter().chain(&late).map(|e| e.t_recv.ns() / 1_000_000).collect();
        assert_eq!(times, [10, 20, 30, 30]);
        let numbers: Vec<u64> = first.iter().chain(&late).map(|e| e.seq).collect();
        assert_eq!(numbers, [0, 1, 2, 3]);
    }

    #[test]
    fn frames_are_held_by_their_bytes() {
        let queue = EventQueue::new(3);
        let large: Arc<[u8]> = Arc::from(vec![0; FRAME_BYTES / 4]);
        for n in 0..10 {
            queue.put_frame(at(n), FramePayload { data: Arc::clone(&large), ..frame(n) });
        }
        let frames = |e: &Event| matches!(&e.body, EventBody::Frame(frame) if frame.t_exposure >= at(6));
        let events = drain(&queue);
        assert_eq!(events.iter().filter(|e| frames(e)).count(), 4, "{}", events.len());
        assert!(matches!(events[0].body, EventBody::Dropped { source: Source::Camera, count: 6 }));
    }

    #[test]
    fn a_burst_is_kept() {
        let queue = EventQueue::new(2);
        for round in [0, 400, 1000, 5000] {
            // Given a computer that stood still, after which everything arrives at once.
            for n in 0..BURST as i64 {
                queue.put_frame(at(round + n), frame(round + n));
            }
            // Then all of it is in the queue, in order.
            let events = drain(&queue);
            assert_eq!(events.len(), BURST);
            assert!(events.iter().all(|e| matches!(e.body, EventBody::Frame(_))), "{events:?}");
        }
    }

    #[test]
    fn a_pipeline_that_is_too_slow_handles_new_frames() {
        // Given a pipeline that takes two frames of three, for ten seconds.
        let queue = EventQueue::new(3);
        let mut ages = Vec::new();
        for n in 0..300 {
            queue.put_frame(at(n * 33), frame(n * 33));
            if n % 3 != 0 {
                let taken = std::iter::from_fn(|| queue.take(Duration::ZERO));
                let newest = taken.take(2).find(|e| matches!(e.body, EventBody::Frame(_)));
                ages.extend(newest.map(|e| n * 33 - e.t_recv.ns() / 1_000_000));
            }
        }
        // Then no frame is older than a queue of three allows, once the load is known not to be a burst.
        let late = ages[60..].iter().max().copied();
        assert!(late <= Some(100), "{ages:?}");
    }

    #[test]
    fn the_newest_frames_win_and_the_loss_is_reported() {
        // Given frames that nobody takes for longer than the longest burst.
        let queue = EventQueue::new(2);
        for ms in [10, 20, 30, 40, 600] {
            queue.put_frame(at(ms), frame(ms));
        }
        let events = drain(&queue);
        assert!(
            matches!(events[0].body, EventBody::Dropped { source: Source::Camera, count: 3 }),
            "{:?}",
            events[0]
        );
        let kept: Vec<(u32, i64)> = events[1..]
            .iter()
            .filter_map(|e| match &e.body {
                EventBody::Frame(f) => Some((f.index, f.t_exposure.ns() / 1_000_000)),
                _ => None,
            })
            .collect();
        assert_eq!(kept, [(0, 40), (1, 600)]);
    }

    #[test]
    fn a_pipeline_behind_on_reads_still_sees_frames() {
        // Given a pipeline that is three reads behind and takes one read in the time of a frame.
        let queue = EventQueue::new(2);
        for ms in [0, 10, 20] {
            queue.put(at(ms), EventBody::Bytes { source: Source::Compass, data: vec![0] });
        }
        let mut taken = Vec::new();
        for ms in (30..300).step_by(10) {
            queue.put_frame(at(ms), frame(ms));
            queue.put(at(ms + 1), EventBody::Bytes { source: Source::Compass, data: vec![0] });
            taken.extend(queue.take(Duration::ZERO));
        }
        // Then it still reaches a frame, after the reads before it, and the losses are reported with it, once.
        let frames = taken.iter().filter(|e| matches!(e.body, EventBody::Frame(_))).count();
        let losses = taken.iter().filter(|e| matches!(e.body, EventBody::Dropped { .. })).count();
        assert!(
            frames >= 3 && losses <= frames,
            "{frames} frames, losses reported {losses} times: {taken:?}"
        );
    }

    /// Feeds a queue for a minute: a read every 10 ms and a frame every 100 ms, and a pipeline that takes the given
    /// time for each. Returns the lateness and the time of each handled frame, and the number of lost frames.
    fn behind(read_ms: i64, frame_ms: i64) -> (Vec<(i64, i64)>, u32) {
        let queue = EventQueue::new(3);
        let (mut now, mut fed, mut handled, mut lost) = (0, 0, Vec::new(), 0);
        while now < 60_000 {
            while fed <= now {
                queue.put(at(fed), EventBody::Bytes { source: Source::Compass, data: vec![0] });
                if fed % 100 == 0 {
                    queue.put_frame(at(fed), frame(fed));
                }
                fed += 10;
            }
            match queue.take(Duration::ZERO).map(|event| event.body) {
                None => now = fed,
                Some(EventBody::Frame(f)) => {
                    handled.push((now, now - f.t_exposure.ns() / 1_000_000));
                    now += frame_ms;
                }
                Some(EventBody::Dropped { count, .. }) => lost += count,
                Some(_) => now += read_ms,
            }
        }
        (handled, lost)
    }

    #[test]
    fn a_pipeline_that_is_behind_catches_up_before_it_takes_a_frame() {
        // Given a pipeline that has a fifth of its time left for frames of 900 ms, when it runs for a minute.
        let (handled, lost) = behind(8, 900);
        // Then no handled frame is old, as many frames are handled as there is time for, and the rest is dropped and
        // counted.
        assert!(handled.iter().all(|(_, late)| *late <= 520), "{handled:?}");
        assert!((9..=16).contains(&handled.len()), "{} frames: {handled:?}", handled.len());
        assert!((550..=600).contains(&(lost as usize + handled.len())), "{lost} lost, {handled:?}");
    }

    #[test]
    fn a_pipeline_that_never_catches_up_handles_no_frame_of_long_ago() {
        // Given a pipeline that is too slow for the reads alone, then frames are dropped and counted.
        let (handled, lost) = behind(12, 100);
        assert!(handled.iter().all(|(_, late)| *late <= 2_100), "{handled:?}");
        assert!(lost > 50 && !handled.is_empty(), "{lost} lost, {handled:?}");
    }

    #[test]
    fn who_is_woken_does_not_wait() {
        let queue = EventQueue::new(1);
        queue.wake();
        assert!(queue.take(Duration::from_secs(3_600)).is_none());
    }

    #[test]
    fn reads_are_bounded() {
        let queue = EventQueue::new(1);
        for n in 0..READS + 5 {
            queue.put(at(n as i64), EventBody::Bytes { source: Source::Compass, data: vec![0] });
        }
        let events = drain(&queue);
        assert_eq!(events.len(), READS + 1);
        assert!(matches!(events[0].body, EventBody::Dropped { source: Source::Compass, count: 5 }));
    }
}
