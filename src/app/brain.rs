//! The pipeline's task: takes events in order, has them recorded, handles them, passes on what follows.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::config::Config;
use crate::pipeline::Pipeline;
use windhover_base::msg::{EstimatorOutput, Event, EventBody, Health, Output, TargetEstimate, TimedOutput};
use windhover_base::time::Span;

use super::card::{CardOrders, Slot};
use super::config_file;
use super::devices::Surroundings;
use super::events::{self, OperatorEvent};
use super::health::{Figures, HealthLine};
use super::latencies::Latencies;
use super::sink::{Outlets, Sink};
use super::supervise::Heart;
use super::warm::{self, Earlier, Origin};

/// What the health task and the pipeline's task show each other. Copies are the same board.
#[derive(Clone, Debug, Default)]
pub struct Board(Arc<Mutex<Shown>>);

/// What is on the board.
#[derive(Clone, Debug, Default)]
pub struct Shown {
    /// Figures that only a running daemon has; the health task keeps them.
    pub figures: Figures,
    /// The pipeline's last health; the pipeline's task keeps it.
    pub health: Option<Health>,
}

impl Board {
    /// Looks at the board, or changes it.
    pub fn with<T>(&self, look: impl FnOnce(&mut Shown) -> T) -> T {
        look(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// How long the task waits for an event before it beats and lets time pass.
const PATIENCE: Duration = Duration::from_millis(20);

/// Longest that is spent on what waits when the end was asked for.
const LAST_CALL: Span = Span::from_ns(500_000_000);

/// Runs the pipeline until the end is asked for and everything that waits is handled.
pub fn run(
    config: &Config,
    around: &Surroundings,
    board: &Board,
    (slot, outlets): (Slot, Outlets<Box<dyn Sink>>),
    orders: &CardOrders,
    heart: &Heart,
) {
    let mut brain = Brain {
        config,
        around,
        board,
        origin: Origin::here(config, around.clock),
        slot,
        outlets,
        pipeline: Pipeline::with_terrain(config, config_file::terrain_of(config)),
        latencies: Latencies::default(),
        health_line: HealthLine::new(config),
        outputs: Vec::new(),
    };
    brain.continue_from_earlier(heart);
    let mut end = None;
    loop {
        heart.beat();
        if around.stop.asked() {
            let now = around.clock.now();
            if now - *end.get_or_insert(now) > LAST_CALL {
                break;
            }
        }
        match around.inbox.take(PATIENCE) {
            Some(event) => brain.handle(&event),
            None if around.stop.asked() => break,
            None => brain.pass_time(),
        }
    }
    brain.finish();
    orders.last_word.ask();
}

struct Brain<'a> {
    config: &'a Config,
    around: &'a Surroundings,
    board: &'a Board,
    origin: Origin,
    slot: Slot,
    outlets: Outlets<Box<dyn Sink>>,
    pipeline: Pipeline,
    latencies: Latencies,
    health_line: HealthLine,
    outputs: Vec<TimedOutput>,
}

impl Brain<'_> {
    /// Continues from what an earlier run left on the card, where that is fresh. It is an event like
    /// every other, the first of all: what flew is what replays.
    fn continue_from_earlier(&mut self, heart: &Heart) {
        if !self.config.store.enabled {
            return;
        }
        let tell = |words: String| self.around.log.tell(OperatorEvent::WarmStart, "", words);
        match warm::wait_for(&self.slot, &self.origin, self.around, heart) {
            Earlier::Known(state, age) => {
                tell(format!("continues from what was known {:.1} s ago", age.s()));
                let body = EventBody::Warm(state);
                let event = self.around.inbox.number(self.around.began, body);
                self.handle(&event);
            }
            Earlier::Unusable(stale) => tell(format!("what an earlier run knew is not used: {stale}")),
            Earlier::NotTold(patience) => tell(format!(
                "begins anew: the card did not tell within {:.0} s what an earlier run knew",
                patience.s()
            )),
            Earlier::Nothing => {}
        }
    }

    fn pass_time(&mut self) {
        if let Some(t) = self.pipeline.tick_due(self.around.clock.now()) {
            let tick = self.around.inbox.number(t, EventBody::Tick);
            self.pipeline.handle(&tick, &mut self.outputs);
            self.pass_on();
        }
    }

    fn handle(&mut self, event: &Event) {
        // Recorded first: what the pipeline stumbles over is on the card.
        self.outlets.event(event);
        self.pipeline.handle(event, &mut self.outputs);
        self.pass_on();
    }

    fn finish(&mut self) {
        self.pipeline.finish(&mut self.outputs);
        self.pass_on();
        if let Some(all) = self.latencies.of_flight() {
            events::latencies(&all);
        }
    }

    /// Passes on what followed.
    fn pass_on(&mut self) {
        let outputs = std::mem::take(&mut self.outputs);
        for timed in &outputs {
            match &timed.output {
                Output::Notice(notice) => events::notice(notice),
                Output::Health(health) => self.health(health),
                Output::Estimator(EstimatorOutput::Estimate(estimate)) => self.estimate(estimate),
                _ => {}
            }
            self.outlets.output(timed);
        }
        self.outputs = outputs;
        self.outputs.clear();
    }

    fn estimate(&mut self, estimate: &TargetEstimate) {
        if estimate.target == 0 {
            self.latencies.push(self.around.clock.now() - estimate.t_valid);
        }
    }

    fn health(&mut self, health: &Health) {
        let (p50, p99) = (self.latencies.quantile(0.5), self.latencies.quantile(0.99));
        let figures = self.board.with(|shown| {
            shown.figures.latency_p50 = p50;
            shown.figures.latency_p99 = p99;
            shown.health = Some(health.clone());
            shown.figures.clone()
        });
        self.outlets.figures(figures.by_name());
        self.health_line.emit(health, Some(&figures));
        if let (Some(state), Some(store)) = (self.pipeline.warm_state(), self.slot.get()) {
            warm::save(&store, &self.origin, health.t, &state);
        }
    }
}
