//! Records of a fixed length after a mark, with a sum of their bytes at the end: those of WitMotion and BNO08x.

use std::collections::VecDeque;

use super::reading::{CompassReading, ReceivedAttitude, received};
use crate::counts::{DecodeCounts, Refusal};
use crate::lines::LineSpan;
use windhover_base::time::MonoTime;

/// Format of a device's records, and their reader.
#[derive(Clone, Copy, Debug)]
pub(super) struct RecordForm {
    /// Bytes that begin a record.
    pub mark: &'static [u8],
    /// Length including mark and sum.
    pub length: usize,
    /// Index of the first summed byte: up to the last but one, modulo 256.
    pub summed_from: usize,
    /// Reads a record.
    pub read: Read,
}

/// Reads a record; `None` where it has no attitude. Values left out are counted.
type Read = fn(&[u8], &mut Gathered, &mut DecodeCounts) -> Result<Option<CompassReading>, Refusal>;

/// Values from records before the one with the attitude.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Gathered {
    /// Specific force, device axes as the form gives them, forward-right-down, m/s².
    pub force_mps2: Option<[f64; 3]>,
    /// Rates of turn, the same axes, rad/s.
    pub rate_rps: Option<[f64; 3]>,
}

/// Collects bytes into records.
#[derive(Clone, Debug)]
pub(super) struct RecordFramer {
    form: RecordForm,
    buffer: VecDeque<u8>,
    gathered: Gathered,
}

impl RecordFramer {
    pub(super) fn new(form: RecordForm) -> Self {
        Self { form, buffer: VecDeque::with_capacity(form.length), gathered: Gathered::default() }
    }

    /// Takes the bytes of one read; appends the completed samples.
    pub(super) fn push(
        &mut self,
        bytes: &[u8],
        t_recv: MonoTime,
        counts: &mut DecodeCounts,
        out: &mut Vec<ReceivedAttitude>,
    ) {
        for (index, &byte) in bytes.iter().enumerate() {
            self.buffer.push_back(byte);
            if !self.is_record(counts) {
                continue;
            }
            let record: Vec<u8> = self.buffer.drain(..).collect();
            let bytes_after = bytes.len() - 1 - index;
            let span = LineSpan { t_last: t_recv, bytes_after, bytes: record.len(), ..LineSpan::default() };
            match (self.form.read)(&record, &mut self.gathered, counts) {
                Ok(Some(reading)) => {
                    counts.used += 1;
                    out.push(received(reading, span, span, counts));
                }
                Ok(None) => counts.ignored += 1,
                Err(why) => counts.refuse(why),
            }
        }
    }

    /// Whether the buffer is a complete valid record; bytes that cannot begin one are dropped.
    fn is_record(&mut self, counts: &mut DecodeCounts) -> bool {
        loop {
            let begun = self.buffer.iter().zip(self.form.mark).all(|(byte, mark)| byte == mark);
            if begun && self.buffer.len() < self.form.length {
                return false;
            }
            if begun && self.sum_is_right() {
                return true;
            }
            if begun {
                counts.refuse(Refusal::BadChecksum);
            }
            counts.noise_bytes += 1;
            self.buffer.pop_front();
        }
    }

    fn sum_is_right(&self) -> bool {
        let summed = self.buffer.range(self.form.summed_from..self.form.length - 1);
        let sum = summed.fold(0u8, |sum, byte| sum.wrapping_add(*byte));
        self.buffer.back() == Some(&sum)
    }
}

/// The signed number of two bytes at `index`, low byte first.
pub(super) fn figure(record: &[u8], index: usize) -> f64 {
    let byte = |at: usize| record.get(at).copied().unwrap_or(0);
    f64::from(i16::from_le_bytes([byte(index), byte(index + 1)]))
}
