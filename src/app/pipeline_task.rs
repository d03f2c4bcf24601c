//! The pipeline's task: takes events in order, has them recorded, handles them, forwards the outputs.

use std::sync::Arc;
use std::time::Duration;

use crate::config::Config;
use crate::pipeline::Pipeline;
use windhover_base::geo::Tile;
use windhover_base::msg::{EstimatorOutput, Event, EventBody, Health, Output, TargetEstimate, TimedOutput};
use windhover_base::time::{MonoTime, Span};

use super::context::TaskContext;
use super::events::{self, OperatorEvent};
use super::flight_store::{FlightStore, StoreOrders};
use super::health::HealthLine;
use super::latencies::Latencies;
use super::sink::{Outlets, Sink};
use super::status::SharedStatus;
use super::supervise::Heartbeat;
use super::warm_start::{self, Earlier, Origin};

/// Longest time spent on queued events after a stop was requested.
const LAST_CALL: Span = Span::from_ns(500_000_000);

/// What the pipeline's task works with.
pub struct Parts {
    /// The configuration.
    pub config: Arc<Config>,
    /// Its terrain, where it names one.
    pub terrain: Option<Arc<Tile>>,
    /// The context of every task.
    pub context: TaskContext,
    /// Where health is published.
    pub status: SharedStatus,
    /// Where the state of an earlier run is kept.
    pub flight_store: FlightStore,
    /// Where events and outputs go.
    pub outlets: Outlets<Box<dyn Sink>>,
    /// Requests to the store.
    pub orders: StoreOrders,
    /// The task's heartbeat.
    pub heartbeat: Heartbeat,
}

/// Runs the pipeline on the calling thread until a stop is requested and every queued event is handled.
pub fn run(parts: Parts) {
    let Parts { config, terrain, context, status, flight_store, outlets, orders, heartbeat } = parts;
    let mut task = PipelineTask {
        config: &config,
        context: &context,
        status: &status,
        origin: Origin::here(&config, context.clock),
        flight_store,
        outlets,
        pipeline: Pipeline::with_terrain((&*config).into(), terrain),
        latencies: Latencies::default(),
        health_line: HealthLine::new(&config),
        outputs: Vec::new(),
    };
    task.continue_from_earlier(&heartbeat);
    let mut end = None;
    loop {
        heartbeat.beat();
        let now = context.clock.now();
        if context.stop.is_cancelled() && now - *end.get_or_insert(now) > LAST_CALL {
            break;
        }
        match context.events.take(task.until_tick(now)) {
            Some(event) => task.handle(&event),
            None if context.stop.is_cancelled() => break,
            None => task.pass_time(),
        }
    }
    task.finish();
    orders.pipeline_done.cancel();
}

/// An event that was stamped before a tick may be queued up to this much after it and still come first.
const QUEUED_LATE: Span = Span::from_ns(5_000_000);

struct PipelineTask<'a> {
    config: &'a Config,
    context: &'a TaskContext,
    status: &'a SharedStatus,
    origin: Origin,
    flight_store: FlightStore,
    outlets: Outlets<Box<dyn Sink>>,
    pipeline: Pipeline,
    latencies: Latencies,
    health_line: HealthLine,
    outputs: Vec<TimedOutput>,
}

impl PipelineTask<'_> {
    /// Continues from the state that an earlier run left on the card, where it is fresh. The state is an event like
    /// every other, and the first: replay repeats it.
    fn continue_from_earlier(&mut self, heartbeat: &Heartbeat) {
        if !self.config.store.enabled {
            return;
        }
        let report = |words: String| OperatorEvent::WarmStart.emit("", words);
        match warm_start::wait_for(&self.flight_store, &self.origin, self.context, heartbeat) {
            Earlier::Known(state, age) => {
                report(format!("continues from a state {:.1} s old", age.s()));
                let body = EventBody::Warm(state);
                let event = self.context.events.number(self.context.began, body);
                self.handle(&event);
            }
            Earlier::Unusable(stale) => report(format!("the state of an earlier run is not used: {stale}")),
            Earlier::NoAnswer(patience) => report(format!(
                "starts without an earlier state: the card did not answer within {:.0} s",
                patience.s()
            )),
            Earlier::Nothing => {}
        }
    }

    /// Time from `now` until the next tick is due, which limits the wait for an event.
    fn until_tick(&self, now: MonoTime) -> Duration {
        let due = self.pipeline.next_tick(now - QUEUED_LATE) + QUEUED_LATE;
        Duration::from_nanos((due - now).ns().unsigned_abs())
    }

    fn pass_time(&mut self) {
        if let Some(t) = self.pipeline.tick_due(self.context.clock.now()) {
            let tick = self.context.events.number(t, EventBody::Tick);
            self.pipeline.handle(&tick, &mut self.outputs);
            self.pass_on();
        }
    }

    fn handle(&mut self, event: &Event) {
        // Recorded first: an event that makes the pipeline fail is then on the card.
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

    /// Forwards the outputs.
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
            self.latencies.push(self.context.clock.now() - estimate.t_valid);
        }
    }

    fn health(&mut self, health: &Health) {
        let (p50, p99) = (self.latencies.quantile(0.5), self.latencies.quantile(0.99));
        let figures = self.status.with(|shown| {
            shown.figures.latency_p50 = p50;
            shown.figures.latency_p99 = p99;
            shown.health = Some(health.clone());
            shown.figures.clone()
        });
        self.outlets.figures(figures.by_name());
        self.health_line.emit(health, Some(&figures));
        if let (Some(state), Some(store)) = (self.pipeline.warm_state(), self.flight_store.get()) {
            warm_start::save(&store, &self.origin, health.t, &state);
        }
    }
}
