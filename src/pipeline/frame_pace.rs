//! How often frames arrive, and since when none has arrived.

use windhover_base::time::{MonoTime, Span};

/// A frame that is late by at most this time is not counted as missing.
const PATIENCE: Span = Span::from_ns(500_000_000);
/// A frame is missing after this many frame times, where frame times are long.
const FRAME_TIMES: f64 = 3.0;
/// Longest wait for a frame before it counts as missing, however slow the camera is.
const LONGEST: Span = Span::from_ns(2_000_000_000);
/// Weight of a new frame time in the running mean.
const SHARE: f64 = 0.125;

/// The camera's frame rate, measured by the arrival times of its frames.
#[derive(Clone, Copy, Debug)]
pub(super) struct FramePace {
    interval_s: f64,
    last: Option<(MonoTime, u32)>,
}

impl FramePace {
    /// For a camera that is configured to deliver `fps` frames a second.
    pub(super) fn new(fps: f64) -> Self {
        Self { interval_s: 1.0 / fps, last: None }
    }

    /// The frame with this number arrived.
    pub(super) fn frame(&mut self, t: MonoTime, number: u32) {
        if let Some((last, _)) = self.last {
            let passed = (t - last).s().clamp(0.0, LONGEST.s());
            self.interval_s += SHARE * (passed - self.interval_s);
        }
        self.last = Some((t, number));
    }

    /// The number of the last frame, if the next one is missing at `t`; `None` while frames arrive, and before the
    /// first.
    pub(super) fn missing_after(&self, t: MonoTime) -> Option<u32> {
        let patience = Span::from_s(FRAME_TIMES * self.interval_s).max(PATIENCE).min(LONGEST);
        self.last.filter(|(last, _)| t - *last > patience).map(|(_, number)| number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(s: f64) -> MonoTime {
        MonoTime::default() + Span::from_s(s)
    }

    #[test]
    fn a_frame_is_missing_after_three_frame_times_and_never_before_half_a_second() {
        let mut pace = FramePace::new(30.0);
        assert_eq!(pace.missing_after(at(100.0)), None, "none was received yet");
        pace.frame(at(0.0), 7);
        assert_eq!((pace.missing_after(at(0.5)), pace.missing_after(at(0.6))), (None, Some(7)));
        // A camera slower than configured is accepted as it is.
        for n in 0..40 {
            pace.frame(at(f64::from(n) * 0.4), n);
        }
        let last = 39.0 * 0.4;
        assert_eq!(
            (pace.missing_after(at(last + 1.0)), pace.missing_after(at(last + 1.3))),
            (None, Some(39))
        );
        // However slow the camera is, after two seconds a frame is missing.
        for n in 0..40 {
            pace.frame(at(100.0 + f64::from(n) * 10.0), n);
        }
        assert_eq!(pace.missing_after(at(100.0 + 390.0 + 2.1)), Some(39));
    }
}
