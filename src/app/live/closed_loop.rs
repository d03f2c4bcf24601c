//! A closed-loop flight in lock-step: world, sensors, pipeline, MAVLink, follower, world.

use std::sync::Arc;

use nalgebra::Vector3;

use super::autopilot::{AUTOPILOT_SYSTEM, SimulatedAutopilot, follow_target};
use crate::config::Config;
use crate::io::mavlink::MavlinkEncoder;
use crate::io::mavlink::companion::Companion;
use crate::pipeline::{Pipeline, PipelineSettings};
use windhover_base::msg::{Event, EventBody, Source};
use windhover_base::time::{MonoTime, Span};
use windhover_decode::MavlinkFrames;
use windhover_simulate::{
    ClosedFlight, FlightError, FollowTarget, Follower, FollowerTuning, Lateness, OwnshipTruth, Scenario,
    VehicleTruth, World,
};

/// Delay of the autopilot's messages.
const LINK: Span = Span::from_ns(4_000_000);

/// The settings of a flight.
#[derive(Clone, Debug, Default)]
pub struct LoopSettings {
    /// Additional delay of frames and compass.
    pub lateness: Lateness,
    /// Error of the autopilot's receiver, north, east, down, metres.
    pub receiver_m: Vector3<f64>,
    /// The follower gets the truth instead of the estimates.
    pub truth: bool,
    /// No frame comes after this time, seconds.
    pub camera_dies_s: Option<f64>,
    /// The autopilot restarts at this time, seconds.
    pub reboots_s: Option<f64>,
    /// On the same line is the autopilot of another helicopter, this far away: north, east, down, metres.
    pub another_m: Option<Vector3<f64>>,
    /// Threads that render.
    pub threads: usize,
}

/// The situation after a step.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// Seconds into the flight.
    pub t_s: f64,
    /// The helicopter.
    pub own: OwnshipTruth,
    /// The vehicle.
    pub vehicle: VehicleTruth,
    /// The message that the follower received in this step, if any, north, east, down of the world's origin.
    pub received: Option<FollowTarget>,
}

/// A flight whose helicopter follows the estimates of the vehicle.
pub struct ClosedLoop {
    flight: ClosedFlight,
    pipeline: Pipeline,
    encoder: MavlinkEncoder,
    companion: Companion,
    autopilot: SimulatedAutopilot,
    another: Option<SimulatedAutopilot>,
    follower: Follower,
    settings: LoopSettings,
    has_autopilot: bool,
    system_id: u8,
    next_tell: MonoTime,
    next_second: MonoTime,
    seq: u64,
    /// The autopilot's bytes in transit.
    coming: Vec<(MonoTime, Vec<u8>)>,
}

impl ClosedLoop {
    /// A flight of this scenario with the configuration that `configure` makes from the scenario's own.
    pub fn new(
        scenario: Scenario,
        seed: u64,
        configure: impl FnOnce(&mut Config),
        settings: LoopSettings,
    ) -> Self {
        let mut config = Config::of_rig(scenario.rig.clone(), scenario.ground());
        configure(&mut config);
        let tuning = FollowerTuning { height_m: scenario.helicopter.height_m, ..FollowerTuning::default() };
        let world = Arc::new(World::flown(scenario, seed));
        let begin = world.time(0.0);
        Self {
            // A follower that gets the truth needs no pictures.
            flight: ClosedFlight::new(
                world,
                settings.lateness,
                if settings.truth { 0 } else { settings.threads.max(1) },
            ),
            pipeline: Pipeline::new(PipelineSettings::from(&config)),
            encoder: MavlinkEncoder::new(
                &config.mavlink,
                &config.target,
                &config.ground,
                &config.camera,
                None,
            ),
            companion: Companion::new(None, true),
            autopilot: SimulatedAutopilot::new(AUTOPILOT_SYSTEM, settings.receiver_m)
                .rebooting(settings.reboots_s),
            another: settings.another_m.map(|away_m| SimulatedAutopilot::new(AUTOPILOT_SYSTEM + 1, away_m)),
            follower: Follower::new(tuning),
            settings,
            has_autopilot: config.autopilot.is_some(),
            system_id: config.mavlink.system_id,
            next_tell: begin,
            next_second: begin,
            seq: 0,
            coming: Vec::new(),
        }
    }

    /// The simulated world.
    pub fn world(&self) -> &Arc<World> {
        self.flight.world()
    }

    /// Advances by [`World::STEP`].
    pub fn step(&mut self) -> Result<Moment, FlightError> {
        let world = Arc::clone(self.flight.world());
        let now = self.flight.now();
        let (position, velocity) = self.autopilot.position(&world, now);
        let wanted = self.follower.command(now, &position, &velocity);
        world.fly(&wanted);
        let mut events = Vec::new();
        self.flight.step(&mut events)?;
        let t = self.flight.now();
        self.hear_autopilot(&world, t, &mut events);
        let received = match self.settings.truth {
            true => self.tell_truth(&world, t),
            false => self.tell(&world, t, &mut events),
        };
        if let Some(received) = &received {
            self.follower.hear(received, t);
        }
        let t_s = world.seconds(t);
        Ok(Moment { t_s, own: world.ownship(t), vehicle: world.vehicle(0, t), received })
    }

    /// Merges the autopilot's messages into the events, at their arrival.
    fn hear_autopilot(&mut self, world: &World, t: MonoTime, events: &mut Vec<Event>) {
        let mut bytes = Vec::new();
        self.autopilot.says(world, t, &mut bytes);
        if let Some(another) = &mut self.another {
            another.says(world, t, &mut bytes);
        }
        if t >= self.next_second {
            self.next_second += Span::from_s(1.0);
            let mut asked = Vec::new();
            self.companion.every_second(t, &mut asked);
            let mut frames = Vec::new();
            asked.iter().for_each(|frame| MavlinkFrames::default().push(frame, &mut frames));
            frames.iter().for_each(|frame| self.autopilot.hears(world, frame, t + LINK, &mut bytes));
        }
        if self.has_autopilot && !bytes.is_empty() {
            self.coming.push((t + LINK + LINK, bytes));
        }
        for (at, data) in self.coming.extract_if(.., |(at, _)| *at <= t).collect::<Vec<_>>() {
            let mut frames = Vec::new();
            MavlinkFrames::default().push(&data, &mut frames);
            for frame in &frames {
                self.companion.receive(frame, at, &mut Vec::new());
            }
            events.push(Event {
                t_recv: at,
                seq: 0,
                body: EventBody::Bytes { source: Source::Autopilot, data },
            });
        }
        events.sort_by_key(|event| event.t_recv);
    }

    /// Runs events through the pipeline and sends the outputs as MAVLink.
    fn tell(&mut self, world: &World, t: MonoTime, events: &mut Vec<Event>) -> Option<FollowTarget> {
        let dead = self.settings.camera_dies_s.is_some_and(|from| world.seconds(t) >= from);
        events.retain(|event| !(dead && matches!(event.body, EventBody::Frame(_))));
        if let Some(tick) = self.pipeline.tick_due(t) {
            events.push(Event { t_recv: tick.max(t), seq: 0, body: EventBody::Tick });
        }
        let mut outputs = Vec::new();
        for event in events.iter_mut() {
            event.seq = self.seq;
            self.seq += 1;
            self.pipeline.handle(event, &mut outputs);
        }
        outputs.iter().for_each(|output| self.encoder.output(&output.output));
        if t < self.next_tell {
            return None;
        }
        self.next_tell += self.encoder.every();
        let mut frames = Vec::new();
        self.encoder.tell(t, &mut frames);
        let scenario = world.scenario();
        let origin_msl_m = scenario.origin.height_m - scenario.geoid_m;
        frames.iter().find_map(|frame| follow_target(frame, self.system_id, world.frame(), origin_msl_m))
    }

    /// Sends the truth at the same rate and resolution, relative to the place that the receiver reports.
    fn tell_truth(&mut self, world: &World, t: MonoTime) -> Option<FollowTarget> {
        if t < self.next_tell {
            return None;
        }
        self.next_tell += self.encoder.every();
        let velocity = |t: MonoTime| {
            let vehicle = world.vehicle(0, t);
            let (s, c) = vehicle.heading_rad.sin_cos();
            Vector3::new(c, s, 0.0) * vehicle.speed_mps
        };
        let (half, vehicle) = (Span::from_ms(20.0), world.vehicle(0, t));
        Some(FollowTarget {
            stamp: t - world.time(0.0),
            position_m: vehicle.origin() + self.settings.receiver_m,
            velocity_mps: velocity(t),
            acceleration_mps2: (velocity(t + half) - velocity(t - half)) / (2.0 * half.s()),
        })
    }
}
