//! The trait of every output: it takes the pipeline's events, outputs and records; and a list of outputs.

use std::sync::Arc;

use crate::io::records::{DaemonFigures, OutputEncoder, Record};
use windhover_base::msg::{Event, TimedOutput};

/// A record on its way out.
#[derive(Clone, Debug)]
pub struct OutgoingRecord {
    /// The record.
    pub record: Arc<Record>,
    /// The number by which ground stations may request it again; the link's sink assigns it.
    pub number: Option<u32>,
}

/// An output of the program. A sink never waits: the pipeline's thread calls it. It implements the calls that it needs.
pub trait Sink: Send {
    /// An event, before the pipeline handles it.
    fn event(&mut self, _event: &Event) {}

    /// An output, before its records.
    fn output(&mut self, _output: &TimedOutput) {}

    /// One record of an output.
    fn record(&mut self, _record: &mut OutgoingRecord) {}
}

impl Sink for Box<dyn Sink> {
    fn event(&mut self, event: &Event) {
        (**self).event(event);
    }

    fn output(&mut self, output: &TimedOutput) {
        (**self).output(output);
    }

    fn record(&mut self, record: &mut OutgoingRecord) {
        (**self).record(record);
    }
}

/// Sinks in order: what one of them does to a record, those after it see.
pub struct Outlets<S> {
    /// The sinks.
    pub sinks: Vec<S>,
    encoder: OutputEncoder,
    records: Vec<Record>,
}

impl<S: Sink> Outlets<S> {
    /// These sinks, in this order.
    pub fn new(encoder: OutputEncoder, sinks: Vec<S>) -> Self {
        Self { sinks, encoder, records: Vec::new() }
    }

    /// Passes an event to every sink.
    pub fn event(&mut self, event: &Event) {
        self.sinks.iter_mut().for_each(|sink| sink.event(event));
    }

    /// Values of the daemon for the next health messages.
    pub fn figures(&mut self, figures: DaemonFigures) {
        self.encoder.figures = figures;
    }

    /// Passes an output and its records to every sink.
    pub fn output(&mut self, output: &TimedOutput) {
        if self.sinks.is_empty() {
            return;
        }
        self.sinks.iter_mut().for_each(|sink| sink.output(output));
        self.encoder.output(&output.output, output.t_cause, &mut self.records);
        for record in self.records.drain(..) {
            let mut outgoing = OutgoingRecord { record: Arc::new(record), number: None };
            self.sinks.iter_mut().for_each(|sink| sink.record(&mut outgoing));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use windhover_base::geo::Geodetic;
    use windhover_base::msg::{EventBody, Output};
    use windhover_base::time::MonoTime;

    /// Counts its calls; numbers records where configured, and keeps the numbers that it sees.
    #[derive(Default)]
    struct Counter {
        events: usize,
        outputs: usize,
        number_from: Option<u32>,
        seen: Vec<Option<u32>>,
    }

    impl Sink for Counter {
        fn event(&mut self, _event: &Event) {
            self.events += 1;
        }

        fn output(&mut self, _output: &TimedOutput) {
            self.outputs += 1;
        }

        fn record(&mut self, record: &mut OutgoingRecord) {
            self.seen.push(record.number);
            if let Some(next) = &mut self.number_from {
                record.number = Some(*next);
                *next += 1;
            }
        }
    }

    #[test]
    fn every_sink_gets_everything_and_later_ones_see_the_number() {
        let config = Config::parse(include_str!("../../config/windhover.toml")).expect("valid");
        let encoder = OutputEncoder::new(&config.target);
        let first = Counter { number_from: Some(5), ..Counter::default() };
        let mut outlets = Outlets::new(encoder, vec![first, Counter::default()]);
        let t_cause = MonoTime::from_ns(7);
        let datum = Geodetic { lat_deg: 1.0, lon_deg: 2.0, height_m: 3.0 };
        outlets.event(&Event { t_recv: t_cause, seq: 0, body: EventBody::Pulse });
        for _ in 0..2 {
            outlets.output(&TimedOutput { t_cause, output: Output::Datum(t_cause, datum) });
        }
        assert!(outlets.sinks.iter().all(|sink| (sink.events, sink.outputs) == (1, 2)));
        assert_eq!(outlets.sinks[0].seen, [None, None]);
        assert_eq!(outlets.sinks[1].seen, [Some(5), Some(6)]);
    }
}
