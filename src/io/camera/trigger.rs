//! Frames counted against the pulses that trigger the camera: a pulse without a frame is a lost frame.
//!
//! A frame's stamp follows its pulse by exposure, readout and transfer. That delay is learnt: a frame belongs to the pulse
//! whose delay is nearest to it, and the pulses passed over are lost frames. The driver's own count misses what a camera loses
//! before the driver.

use std::collections::VecDeque;

use windhover_base::time::{MonoTime, Span};

/// Pulses that wait for their frames, at most; the oldest is forgotten first.
const WAITING: usize = 256;

/// Share of a new delay in the learnt one.
const LEARNING: f64 = 0.1;

/// Frames that can be ahead of the reading of their pulses.
const MOST_AHEAD: u32 = 4;

/// Frames without any pulse after which the line is reported as silent.
const SILENT_FRAMES: u32 = 20;

/// What a frame shows about the pulses.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Counted {
    /// Every pulse has its frame.
    Complete,
    /// Pulses whose frames did not come, and the time of the first of them.
    Lost(u32, MonoTime),
    /// Frames come, pulses do not.
    Silent,
}

/// Pulses, and which of them have their frame.
#[derive(Debug, Default)]
pub struct TriggerCount {
    pulses: VecDeque<MonoTime>,
    /// The newest pulse, and its distance from the one before.
    newest: Option<MonoTime>,
    apart_ns: f64,
    /// Learnt time from pulse to stamp.
    delay_ns: Option<f64>,
    /// Frames whose pulse was not there yet.
    ahead: u32,
    /// Frames since the last pulse.
    without_pulse: u32,
}

impl TriggerCount {
    /// A pulse of the line.
    pub fn pulse(&mut self, t: MonoTime) {
        if let Some(before) = self.newest.replace(t) {
            self.apart_ns = ns(t - before);
        }
        if self.pulses.len() == WAITING {
            self.pulses.pop_front();
        }
        self.pulses.push_back(t);
        self.without_pulse = 0;
    }

    /// Whether frames are counted against pulses now.
    pub(super) const fn counts(&self) -> bool {
        self.delay_ns.is_some() && self.without_pulse < SILENT_FRAMES
    }

    /// The camera begins anew: pulses until now have no frame.
    pub(super) fn restart(&mut self) {
        self.pulses.clear();
        (self.ahead, self.delay_ns) = (0, None);
    }

    /// A frame with this stamp.
    pub(super) fn frame(&mut self, stamp: MonoTime) -> Counted {
        self.without_pulse = self.without_pulse.saturating_add(1);
        let Some(place) = self.place(stamp) else {
            self.ahead = (self.ahead + 1).min(MOST_AHEAD);
            return if self.without_pulse == SILENT_FRAMES { Counted::Silent } else { Counted::Complete };
        };
        let (first, passed) = (self.pulses[0], u32::try_from(place).unwrap_or(u32::MAX));
        let delay_ns = ns(stamp - self.pulses[place]);
        self.pulses.drain(..=place);
        let lost = passed.saturating_sub(std::mem::take(&mut self.ahead));
        match self.delay_ns.replace(delay_ns) {
            // Pulses before the first frame are of a camera that did not stream yet.
            None => Counted::Complete,
            Some(before) => {
                self.delay_ns = Some(before + LEARNING * (delay_ns - before));
                if lost == 0 { Counted::Complete } else { Counted::Lost(lost, first) }
            }
        }
    }

    /// The place of the pulse to which a stamp belongs; `None` where it has not been read yet.
    fn place(&self, stamp: MonoTime) -> Option<usize> {
        let Some(delay_ns) = self.delay_ns else {
            // The first frame: the newest pulse before it.
            return self.pulses.iter().rposition(|&pulse| pulse <= stamp);
        };
        let off = |place: usize| (ns(stamp - self.pulses[place]) - delay_ns).abs();
        let place = (0..self.pulses.len()).min_by(|&a, &b| off(a).total_cmp(&off(b)))?;
        // A frame far from the newest pulse is of a later one.
        let is_newest = place + 1 == self.pulses.len();
        (!is_newest || off(place) <= self.apart_ns / 2.0).then_some(place)
    }
}

fn ns(span: Span) -> f64 {
    span.ns() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: f64) -> MonoTime {
        MonoTime::default() + Span::from_ms(ms)
    }

    /// Pulses every 50 ms and their frames 70 ms later, a little early or late by turns; without the frames `lost`. Pulses are
    /// read before the frames that come later.
    fn fly(count: &mut TriggerCount, pulses: std::ops::Range<u32>, lost: &[u32]) -> Vec<(u32, u32, f64)> {
        let time = |pulse: u32| f64::from(pulse) * 50.0;
        let stamp = |pulse: u32| time(pulse) + 70.0 + if pulse.is_multiple_of(2) { 20.0 } else { 0.0 };
        let mut found = Vec::new();
        let mut read = pulses.start;
        for frame in pulses.clone().filter(|pulse| !lost.contains(pulse)) {
            while read < pulses.end && time(read) < stamp(frame) {
                count.pulse(at(time(read)));
                read += 1;
            }
            if let Counted::Lost(lost, first) = count.frame(at(stamp(frame))) {
                found.push((frame, lost, (first - MonoTime::default()).ms()));
            }
        }
        found
    }

    #[test]
    fn lost_frames_are_counted_and_named_by_their_pulse() {
        assert_eq!(fly(&mut TriggerCount::default(), 0..100, &[]), []);
        let lost = fly(&mut TriggerCount::default(), 0..100, &[7, 20, 21, 22, 61]);
        assert_eq!(lost.iter().map(|found| found.1).collect::<Vec<_>>(), [1, 3, 1], "{lost:?}");
        // The delay of one and a half periods shows as half a period: the pulse named is the next one, the count is right.
        let first: Vec<f64> = lost.iter().map(|found| found.2).collect();
        assert!(
            first.iter().zip([7.0, 20.0, 61.0]).all(|(t, pulse)| (t - pulse * 50.0).abs() <= 50.0),
            "{first:?}"
        );
    }

    #[test]
    fn frames_lost_at_the_begin_or_while_the_camera_was_away_are_not_counted() {
        let mut count = TriggerCount::default();
        assert_eq!(fly(&mut count, 0..40, &[0, 1, 2, 3]), []);
        count.restart();
        (40..80).for_each(|pulse| count.pulse(at(f64::from(pulse) * 50.0)));
        assert_eq!(fly(&mut count, 80..120, &[]), []);
    }

    #[test]
    fn a_pulse_that_is_read_after_its_frame_is_not_a_lost_one() {
        let mut count = TriggerCount::default();
        for pulse in 0..20_u32 {
            let t = f64::from(pulse) * 50.0;
            let late = pulse == 10;
            if !late {
                count.pulse(at(t));
            }
            assert_eq!(count.frame(at(t + 20.0)), Counted::Complete, "{pulse}");
            if late {
                count.pulse(at(t));
            }
        }
    }

    #[test]
    fn a_line_without_pulses_is_reported_once() {
        let mut count = TriggerCount::default();
        let silent = |count: &mut TriggerCount| {
            let frames = (0..100).map(|frame| count.frame(at(f64::from(frame) * 50.0)));
            frames.filter(|counted| *counted == Counted::Silent).count()
        };
        assert_eq!(silent(&mut count), 1);
        assert!(!count.counts());
        count.pulse(at(5_000.0));
        assert_eq!(count.frame(at(5_010.0)), Counted::Complete);
        assert!(count.counts());
    }
}
