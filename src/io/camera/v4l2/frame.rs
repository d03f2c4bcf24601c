//! Frames out of their buffers, with the driver's count and stamps.

use std::sync::Arc;

use v4l::buffer::Flags;

use super::buffers::Filled;
use super::format;
use crate::io::clock::HostClock;
use crate::io::device::{NoteKind, Report};
use windhover_base::msg::{FrameEncoding, FramePayload};
use windhover_base::time::{MonoTime, Span};

/// A stamp this far before its arrival, or after it, is not the time of exposure.
const OLDEST_STAMP: Span = Span::from_ns(2_000_000_000);

/// State from one frame to the next.
#[derive(Default)]
pub(super) struct Following {
    sequence: Option<u32>,
    newest: Option<MonoTime>,
    bad_stamps_reported: bool,
}

/// The agreed form of the frames.
pub(super) struct Frames {
    pub(super) encoding: FrameEncoding,
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) stride: u32,
}

impl Frames {
    /// Copies one frame out of its buffer; `None` where it is damaged.
    pub(super) fn take(
        &self,
        filled: &Filled<'_>,
        t_recv: MonoTime,
        following: &mut Following,
        clock: HostClock,
        tell: &mut dyn FnMut(Report),
    ) -> Option<FramePayload> {
        let missed = following
            .sequence
            .replace(filled.sequence)
            .map_or(0, |last| filled.sequence.wrapping_sub(last).saturating_sub(1));
        // A driver that restarts its count has not lost four thousand million frames.
        if (1..100_000).contains(&missed) {
            tell(Report::Note(NoteKind::FramesMissed, missed, format!("{missed} frames were not delivered")));
        }
        if Flags::from(filled.flags).contains(Flags::ERROR) {
            tell(Report::Note(
                NoteKind::FrameDamaged,
                1,
                format!("frame {} is flagged as damaged", filled.sequence),
            ));
            return None;
        }
        let used = filled.bytes.len();
        let needed = format::frame_bytes(self.encoding, self.stride as usize, self.height as usize);
        if needed.is_some_and(|needed| used < needed) || used == 0 {
            tell(Report::Note(NoteKind::FrameDamaged, 1, format!("frame {} is incomplete", filled.sequence)));
            return None;
        }
        let t_exposure = self.exposure(filled, t_recv, following, clock, tell);
        let data: Arc<[u8]> = Arc::from(&filled.bytes[..needed.unwrap_or(used)]);
        Some(FramePayload {
            index: 0,
            t_exposure,
            encoding: self.encoding,
            width: self.width,
            height: self.height,
            stride: self.stride,
            data,
        })
    }

    /// The driver's stamp where it is of the monotonic clock, recent, and later than the last; else the arrival.
    fn exposure(
        &self,
        filled: &Filled<'_>,
        t_recv: MonoTime,
        following: &mut Following,
        clock: HostClock,
        tell: &mut dyn FnMut(Report),
    ) -> MonoTime {
        let clock_of_stamp = Flags::from(filled.flags) & Flags::TIMESTAMP_MASK;
        let stamp = clock.from_monotonic(filled.stamp);
        let why = if clock_of_stamp != Flags::TIMESTAMP_MONOTONIC {
            "are not of the monotonic clock"
        } else if stamp > t_recv || t_recv - stamp > OLDEST_STAMP {
            "are not near the arrival"
        } else if following.newest.is_some_and(|newest| stamp <= newest) {
            "do not go forward"
        } else {
            following.newest = Some(stamp);
            following.bad_stamps_reported = false;
            return stamp;
        };
        if !std::mem::replace(&mut following.bad_stamps_reported, true) {
            let text = format!("the driver's stamps {why}; arrival times are used");
            tell(Report::Note(NoteKind::StampsUnusable, 1, text));
        }
        t_recv
    }
}
