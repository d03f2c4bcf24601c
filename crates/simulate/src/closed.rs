//! A flight with a helicopter that is controlled during the flight: sensors measure the motion so far, and their events
//! come in order of reception.

use std::collections::VecDeque;
use std::sync::Arc;

use super::camera::{Exposures, FrameTruth};
use super::compass::Compass;
use super::compass_wire::{WireContext, write_reading};
use super::flight::FlightError;
use super::garmin::write_epoch;
use super::gnss::GnssReceiver;
use super::line::Line;
use super::random::{Purpose, Stream};
use super::render::Renderer;
use super::world::World;
use windhover_base::msg::{Event, EventBody, GrayImage, Source};
use windhover_base::time::{MonoTime, Span};

/// A frame's exposure is jittered: it is taken this long after its nominal time, s.
const EXPOSED_BY_S: f64 = 0.01;

/// Additional lateness of the events, ms: uniform from 0, drawn for each.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Lateness {
    /// Of frames.
    pub frames_ms: f64,
    /// Of reads of the compass's line.
    pub compass_ms: f64,
}

/// The sensors of a flight that is being flown.
///
/// ```
/// use std::sync::Arc;
/// use nalgebra::Vector3;
/// use windhover_simulate::{ClosedFlight, Lateness, Scenario, World};
///
/// let world = Arc::new(World::flown(Scenario::named("hover10").expect("a named scenario"), 7));
/// // Without threads nothing is rendered.
/// let (mut flight, mut events) = (ClosedFlight::new(Arc::clone(&world), Lateness::default(), 0), Vec::new());
/// for _ in 0..200 {
///     // The pilot demands an acceleration; the sensors measure what comes of it.
///     world.fly(&Vector3::new(0.5, 0.0, 0.0));
///     flight.step(&mut events).expect("nothing is compressed");
/// }
/// assert!(flight.now() > world.time(0.5) && !events.is_empty());
/// assert!(world.ownship(flight.now()).velocity_ned_mps.x > 0.0);
/// ```
pub struct ClosedFlight {
    world: Arc<World>,
    renderer: Option<Renderer>,
    gnss: GnssReceiver,
    gnss_line: Line,
    compass: Compass,
    compass_line: Line,
    exposures: Exposures,
    lateness: Lateness,
    late: Stream,
    /// Events in transit, by reception.
    coming: VecDeque<(MonoTime, EventBody)>,
    compass_received: MonoTime,
    flown: MonoTime,
    /// Frames that were exposed and are rendered elsewhere.
    exposed: Vec<FrameTruth>,
    seq: u64,
}

impl ClosedFlight {
    /// Sensors of a flown world ([`World::flown`]) that renders with this many threads; with none, frames are only
    /// [`Self::exposed`]. Dropouts and outages of the scenario are ignored.
    pub fn new(world: Arc<World>, lateness: Lateness, threads: usize) -> Self {
        let rig = &world.scenario().rig;
        let stream = |purpose| Stream::of(world.seed(), purpose);
        Self {
            renderer: (threads > 0).then(|| Renderer::new(Arc::clone(&world)).with_threads(threads)),
            gnss: GnssReceiver::new(&world),
            gnss_line: Line::new(rig.gps.baud, stream(Purpose::GnssLine)),
            compass: Compass::new(&world),
            compass_line: Line::new(rig.compass.baud, stream(Purpose::CompassLine)),
            exposures: Exposures::new(world.seed()),
            lateness,
            late: stream(Purpose::Lateness),
            coming: VecDeque::new(),
            compass_received: world.time(0.0),
            flown: world.time(0.0),
            exposed: Vec::new(),
            seq: 0,
            world,
        }
    }

    /// The simulated world.
    pub fn world(&self) -> &Arc<World> {
        &self.world
    }

    /// The time up to which it has been flown.
    pub fn now(&self) -> MonoTime {
        self.flown
    }

    /// Frames exposed since the last call, where they are not rendered here.
    pub fn exposed(&mut self) -> Vec<FrameTruth> {
        std::mem::take(&mut self.exposed)
    }

    /// The helicopter was advanced by a step: appends the events received by its end.
    pub fn step(&mut self, out: &mut Vec<Event>) -> Result<(), FlightError> {
        self.flown += World::STEP;
        self.measure();
        while let Some((t, _)) = self.coming.front()
            && *t <= self.flown
        {
            let Some((t_recv, body)) = self.coming.pop_front() else { break };
            out.push(Event { t_recv, seq: self.seq, body });
            self.seq += 1;
        }
        Ok(())
    }

    /// Adds new measurements to those in transit.
    fn measure(&mut self) {
        let world = Arc::clone(&self.world);
        let (scenario, now_s) = (world.scenario(), world.seconds(self.flown));
        let mut line = Vec::with_capacity(256);
        while self.gnss.due_s(&world) <= now_s {
            let Some(sample) = self.gnss.next(&world) else { break };
            line.clear();
            write_epoch(scenario, &sample.epoch, &mut line);
            self.gnss_line.send(&line, sample.t_first_byte);
        }
        while self.compass.due_s(&world) <= now_s {
            let Some(sample) = self.compass.next(&world) else { break };
            let context = WireContext {
                format: scenario.rig.compass.format,
                declination_deg: scenario.declination_deg,
                utc: world.utc(world.seconds(sample.t_true)),
            };
            line.clear();
            write_reading(&sample.sample, &context, &mut line);
            self.compass_line.send(&line, sample.t_first_byte);
        }
        while let Some((t, data)) = self.gnss_line.pop() {
            self.put(t, EventBody::Bytes { source: Source::Gps, data });
        }
        while let Some((t, data)) = self.compass_line.pop() {
            // A line keeps its order, however late it is read.
            let late = Span::from_ms(self.late.uniform(0.0, self.lateness.compass_ms.max(1e-9)));
            self.compass_received = self.compass_received.max(t + late);
            self.put(self.compass_received, EventBody::Bytes { source: Source::Compass, data });
        }
        while self.exposures.due_s(&world) + EXPOSED_BY_S <= now_s {
            let Some(truth) = self.exposures.next(&world) else { break };
            let mut image = GrayImage::default();
            let Some(renderer) = &self.renderer else {
                self.exposed.push(truth);
                continue;
            };
            renderer.render(truth.t_true, truth.frame, &mut image);
            let frame = truth.in_grey(image);
            let late = Span::from_ms(self.late.uniform(0.0, self.lateness.frames_ms.max(1e-9)));
            self.put(truth.t_recv + late, EventBody::Frame(frame));
        }
    }

    fn put(&mut self, t: MonoTime, body: EventBody) {
        let place = self.coming.iter().rposition(|(at, _)| *at <= t).map_or(0, |i| i + 1);
        self.coming.insert(place, (t, body));
    }
}
