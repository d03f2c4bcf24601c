//! Records waiting to be sent live: by priority, newest first, the others left to back-fill.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::io::records::{Record, topic};

/// Priority of live records, most urgent first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Class {
    /// Operator's notices, and messages that a map needs once: all of them matter.
    Event,
    /// State of a vehicle.
    Estimate,
    /// Health of all parts.
    Health,
    /// State of the helicopter.
    Ownship,
    /// Not live, but complete after back-fill.
    Later,
}

/// Whether a topic of the flight is sent to the ground, and its priority. Raw serial bytes, camera frames, data that
/// can be computed from other topics, and the filter's internal values stay on the card.
pub fn downlink_class(name: &str) -> Option<Class> {
    match name {
        topic::LOG | topic::DATUM => Some(Class::Event),
        topic::HEALTH => Some(Class::Health),
        topic::OWNSHIP => Some(Class::Ownship),
        topic::GPS_FIX | topic::CAMERA_CALIBRATION | topic::SOURCE_EVENT => Some(Class::Later),
        _ if topic::is_target_now(name) => Some(Class::Estimate),
        _ => None,
    }
}

/// Most notices that wait; older ones are left to back-fill.
const EVENTS_WAITING: usize = 16;

/// One record waiting.
#[derive(Clone, Debug)]
pub struct Waiting {
    /// Its number.
    pub number: u32,
    /// The record.
    pub record: Arc<Record>,
}

/// Records waiting to be sent live: the newest of each topic, and the latest few notices.
#[derive(Debug, Default)]
pub struct LiveQueue {
    events: VecDeque<Waiting>,
    newest: Vec<(Class, Waiting)>,
    thinned: u64,
}

impl LiveQueue {
    /// Adds a record; the one that it replaces is left to back-fill.
    pub fn push(&mut self, number: u32, record: Arc<Record>) {
        let waiting = Waiting { number, record };
        match downlink_class(&waiting.record.topic) {
            None | Some(Class::Later) => {}
            Some(Class::Event) => {
                self.events.push_back(waiting);
                if self.events.len() > EVENTS_WAITING {
                    self.events.pop_front();
                    self.thinned += 1;
                }
            }
            Some(class) => {
                let same = self.newest.iter_mut().find(|(_, w)| w.record.topic == waiting.record.topic);
                match same {
                    Some((_, old)) => {
                        *old = waiting;
                        self.thinned += 1;
                    }
                    None => self.newest.push((class, waiting)),
                }
            }
        }
    }

    /// Removes the most urgent; among equals the one that has waited longest.
    pub fn pop(&mut self) -> Option<Waiting> {
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        let most_urgent = (0..self.newest.len()).min_by_key(|&i| self.newest[i].0)?;
        Some(self.newest.remove(most_urgent).1)
    }

    /// Whether nothing waits.
    pub fn is_empty(&self) -> bool {
        self.events.is_empty() && self.newest.is_empty()
    }

    /// Number of records left to back-fill since the start.
    pub fn thinned(&self) -> u64 {
        self.thinned
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::records::Schema;
    use windhover_base::time::MonoTime;

    fn push(queue: &mut LiveQueue, number: u32, topic: &'static str) {
        let record = Record {
            topic: topic.into(),
            schema: Schema::Log,
            log_time: MonoTime::default(),
            publish_time: MonoTime::default(),
            data: Vec::new(),
        };
        queue.push(number, Arc::new(record));
    }

    #[test]
    fn urgent_first_and_only_the_newest_of_a_state() {
        let mut queue = LiveQueue::default();
        for (number, topic) in [
            (0, "/ownship/state"),
            (1, "/target/a/state"),
            (2, "/target/b/state"),
            (3, "/health"),
            (4, "/target/a/state"),
            (5, "/log"),
            (6, "/log"),
            (7, "/ownship/state"),
            (8, "/gps/serial"),
            (9, "/gps/fix"),
        ] {
            push(&mut queue, number, topic);
        }
        let order: Vec<u32> = std::iter::from_fn(|| queue.pop().map(|w| w.number)).collect();
        assert_eq!(order, [5, 6, 4, 2, 3, 7]);
        assert_eq!(queue.thinned(), 2);
        assert!(queue.is_empty());
    }

    #[test]
    fn a_flood_of_notices_is_bounded() {
        let mut queue = LiveQueue::default();
        for number in 0..1_000 {
            push(&mut queue, number, "/log");
        }
        assert_eq!(queue.pop().map(|w| w.number), Some(1_000 - EVENTS_WAITING as u32));
    }
}
