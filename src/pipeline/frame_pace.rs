//! How often frames come, and since when none does.

use windhover_base::time::{MonoTime, Span};

/// Frames that are late by no more than this are no gap.
const PATIENCE: Span = Span::from_ns(500_000_000);
/// Frame times after which a frame is missing, where they are long.
const FRAME_TIMES: f64 = 3.0;
/// Longest that a missing frame is waited for, however slow the camera is.
const LONGEST: Span = Span::from_ns(2_000_000_000);
/// Share of a new frame time in the mean.
const SHARE: f64 = 0.125;

/// The camera's pace, by the times at which its frames were heard.
#[derive(Clone, Copy, Debug)]
pub(super) struct FramePace {
    interval_s: f64,
    last: Option<(MonoTime, u32)>,
}

impl FramePace {
    /// Of a camera that is to give so many frames a second.
    pub(super) fn new(fps: f64) -> Self {
        Self { interval_s: 1.0 / fps, last: None }
    }

    /// A frame of this number was heard.
    pub(super) fn frame(&mut self, t: MonoTime, number: u32) {
        if let Some((last, _)) = self.last {
            let passed = (t - last).s().clamp(0.0, LONGEST.s());
            self.interval_s += SHARE * (passed - self.interval_s);
        }
        self.last = Some((t, number));
    }

    /// The number of the last frame, where the next one is missing at `t`; `None` while frames come, and before
    /// the first.
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
        assert_eq!(pace.missing_after(at(100.0)), None, "none was heard yet");
        pace.frame(at(0.0), 7);
        assert_eq!((pace.missing_after(at(0.5)), pace.missing_after(at(0.6))), (None, Some(7)));
        // A camera slower than configured is taken as it is.
        for n in 0..40 {
            pace.frame(at(f64::from(n) * 0.4), n);
        }
        let last = 39.0 * 0.4;
        assert_eq!(
            (pace.missing_after(at(last + 1.0)), pace.missing_after(at(last + 1.3))),
            (None, Some(39))
        );
        // However slow it is, after two seconds one is missing.
        for n in 0..40 {
            pace.frame(at(100.0 + f64::from(n) * 10.0), n);
        }
        assert_eq!(pace.missing_after(at(100.0 + 390.0 + 2.1)), Some(39));
    }
}
