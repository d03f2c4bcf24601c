//! A live simulation in real time: a daemon in its own process on pseudo-terminals and a socket, and a helicopter that
//! is flown by a follower over MAVLink or by another program.

use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use nalgebra::Vector3;

use super::autopilot::{AUTOPILOT_SYSTEM, SimulatedAutopilot, follow_target};
use super::devices::{FrameRenderer, FrameSocket, PtyLine};
use super::score::Score;
use super::{Moment, closed_loop::LoopSettings};
use crate::config::{AUTOPILOT, Config};
use crate::io::clock::HostClock;
use windhover_base::msg::{Event, EventBody, Source};
use windhover_base::settings::{AutopilotConfig, AutopilotUse};
use windhover_base::time::MonoTime;
use windhover_decode::MavlinkFrames;
use windhover_simulate::{ClosedFlight, FlightError, Follower, FollowerTuning, Scenario, World};

/// Time between two looks at the clock.
const NAP: Duration = Duration::from_millis(2);
/// Period of the progress messages.
const SAID_EVERY_S: f64 = 5.0;
/// Time after which the filter has settled: the score begins then, in a short flight at its half.
const SETTLED_S: f64 = 15.0;

/// Why a live simulation ended early.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// A line, socket or file cannot be made.
    #[error("{what}: {error}")]
    Io {
        /// What could not be made.
        what: String,
        /// The error.
        error: std::io::Error,
    },
    /// The flight cannot go on.
    #[error(transparent)]
    Flight(#[from] FlightError),
}

/// The files of a live simulation.
#[derive(Clone, Debug)]
pub struct LiveFolder(pub PathBuf);

impl LiveFolder {
    fn at(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    fn text(&self, name: &str) -> String {
        self.at(name).display().to_string()
    }

    /// The daemon's configuration.
    pub fn config_file(&self) -> PathBuf {
        self.at("windhover.toml")
    }

    /// The configuration of a daemon that flies a scenario: its lines, its camera, and the vehicle as MAVLink to the
    /// autopilot and to a ground station on this computer.
    pub fn config_of(&self, scenario: &Scenario) -> Config {
        let mut config = Config::of_rig(scenario.rig.clone(), scenario.ground());
        config.gps.device = self.text("gps");
        config.compass.device = self.text("compass");
        config.camera.device = format!("socket:{}", self.text("camera.sock"));
        let uses = vec![AutopilotUse::Attitude, AutopilotUse::Imu];
        let device = Some(self.text("autopilot"));
        config.autopilot =
            Some(AutopilotConfig { device, baud: 115_200, uses, ..AutopilotConfig::default() });
        config.mavlink.enabled = true;
        config.mavlink.send_to = vec![AUTOPILOT.into(), "127.0.0.1:14550".into()];
        config.store.path = self.text("card");
        config.store.require_mount = false;
        config
    }
}

/// Who flies the helicopter.
enum Flown {
    Follower(Box<Follower>),
    /// Another program, by datagrams of nine numbers: position, velocity, acceleration; north, east, down.
    Driver(UdpSocket),
}

/// A live simulation.
pub struct LiveFlight {
    flight: ClosedFlight,
    world: Arc<World>,
    clock: HostClock,
    autopilot: SimulatedAutopilot,
    flown: Flown,
    gps: PtyLine,
    compass: PtyLine,
    to_daemon: PtyLine,
    from_daemon: MavlinkFrames,
    camera: FrameRenderer,
    system_id: u8,
    moments: Vec<Moment>,
}

impl LiveFlight {
    /// Opens lines and socket in `folder`. The flight begins now. With `driver` another program flies, by UDP datagrams
    /// to that address.
    pub fn open(
        folder: &LiveFolder,
        mut scenario: Scenario,
        seed: u64,
        settings: &LoopSettings,
        driver: Option<&str>,
    ) -> Result<Self, LiveError> {
        let io = |what: &Path| {
            let what = what.display().to_string();
            move |error| LiveError::Io { what, error }
        };
        let line = |name: &str| PtyLine::open(folder.at(name)).map_err(io(&folder.at(name)));
        let clock = HostClock::start();
        scenario.start = clock.now();
        let tuning = FollowerTuning { height_m: scenario.helicopter.height_m, ..FollowerTuning::default() };
        let flown = match driver {
            None => Flown::Follower(Box::new(Follower::new(tuning))),
            Some(address) => {
                let socket = UdpSocket::bind(address).map_err(io(Path::new(address)))?;
                socket.set_nonblocking(true).map_err(io(Path::new(address)))?;
                Flown::Driver(socket)
            }
        };
        let system_id = folder.config_of(&scenario).mavlink.system_id;
        let world = Arc::new(World::flown(scenario, seed));
        let (gps, compass, to_daemon) = (line("gps")?, line("compass")?, line("autopilot")?);
        let socket = folder.at("camera.sock");
        let frames = FrameSocket::open(&socket, clock.less_monotonic()).map_err(io(&socket))?;
        let drawing = Arc::clone(&world);
        let camera =
            FrameRenderer::open(drawing, frames, clock, settings.threads.max(1)).map_err(io(&socket))?;
        Ok(Self {
            flight: ClosedFlight::new(Arc::clone(&world), settings.lateness, 0),
            autopilot: SimulatedAutopilot::new(AUTOPILOT_SYSTEM, settings.receiver_m),
            world,
            clock,
            flown,
            gps,
            compass,
            to_daemon,
            from_daemon: MavlinkFrames::default(),
            camera,
            system_id,
            moments: Vec::new(),
        })
    }

    /// Flies for the scenario's length or until `stop` is set, with progress messages to `say`.
    pub fn run(mut self, stop: &AtomicBool, mut say: impl FnMut(String)) -> Result<Score, LiveError> {
        let end = self.world.time(self.world.scenario().duration_s);
        let mut next_s = SAID_EVERY_S;
        while self.flight.now() < end && !stop.load(Ordering::Relaxed) {
            while self.flight.now() + World::STEP <= self.clock.now() && self.flight.now() < end {
                self.step()?;
            }
            let now_s = self.world.seconds(self.flight.now());
            if now_s >= next_s {
                next_s += SAID_EVERY_S;
                say(self.words(now_s));
            }
            std::thread::sleep(NAP);
        }
        let flown_s = self.world.seconds(self.flight.now());
        Ok(Score::of(&self.moments, SETTLED_S.min(0.5 * flown_s)))
    }

    fn words(&self, now_s: f64) -> String {
        let Some(last) = self.moments.last() else { return String::new() };
        let away = (last.own.position_ned_m - last.vehicle.origin()).xy().norm();
        let recent = self.moments.iter().rev().take(1_000);
        let messages = recent.filter(|moment| moment.received.is_some()).count();
        let behind_ms = (self.clock.now() - self.flight.now()).ms();
        let v = last.vehicle.speed_mps;
        format!(
            "{now_s:.0} s: {away:.2} m from the vehicle, which drives {v:.2} m/s; {messages} messages received in 5 s; simulation {behind_ms:.0} ms behind"
        )
    }

    fn step(&mut self) -> Result<(), LiveError> {
        let t = self.flight.now();
        let (position, velocity) = self.autopilot.position(&self.world, t);
        match &mut self.flown {
            Flown::Follower(follower) => {
                let wanted = follower.command(t, &position, &velocity);
                self.world.fly(&wanted);
            }
            Flown::Driver(socket) => match driven(socket) {
                Some([place, speed, push]) => self.world.put(&place, &speed, &push),
                None => {
                    let own = self.world.ownship(t);
                    let on = own.position_ned_m + own.velocity_ned_mps * World::STEP.s();
                    self.world.put(&on, &own.velocity_ned_mps, &own.acceleration_ned_mps2);
                }
            },
        }
        let mut events = Vec::new();
        self.flight.step(&mut events)?;
        let mut said = Vec::new();
        let now = self.flight.now();
        self.autopilot.says(&self.world, now, &mut said);
        let received = self.hear(now, &mut said);
        self.to_daemon.send(&said);
        events.iter().for_each(|event| self.deliver(event));
        self.flight.exposed().into_iter().for_each(|frame| self.camera.draw(frame));
        let t_s = self.world.seconds(now);
        let (own, vehicle) = (self.world.ownship(now), self.world.vehicle(0, now));
        self.moments.push(Moment { t_s, own, vehicle, received });
        Ok(())
    }

    fn deliver(&mut self, event: &Event) {
        match &event.body {
            EventBody::Bytes { source: Source::Gps, data } => self.gps.send(data),
            EventBody::Bytes { source: Source::Compass, data } => self.compass.send(data),
            _ => {}
        }
    }

    /// Handles the daemon's messages to the autopilot: time requests are answered, the vehicle is followed.
    fn hear(&mut self, now: MonoTime, said: &mut Vec<u8>) -> Option<windhover_simulate::FollowTarget> {
        let mut frames = Vec::new();
        self.from_daemon.push(&self.to_daemon.receive(), &mut frames);
        let scenario = self.world.scenario();
        let origin_msl_m = scenario.origin.height_m - scenario.geoid_m;
        let mut received = None;
        for frame in &frames {
            self.autopilot.hears(&self.world, frame, self.clock.now(), said);
            let target = follow_target(&frame.bytes, self.system_id, self.world.frame(), origin_msl_m);
            received = target.or(received);
        }
        if let (Some(received), Flown::Follower(follower)) = (&received, &mut self.flown) {
            follower.hear(received, now);
        }
        received
    }
}

/// The latest state that the other program sent for the helicopter: position (m), velocity (m/s), acceleration (m/s²).
fn driven(socket: &UdpSocket) -> Option<[Vector3<f64>; 3]> {
    let (mut buffer, mut latest) = ([0; 512], None);
    while let Ok(count) = socket.recv(&mut buffer) {
        let text = std::str::from_utf8(&buffer[..count]).unwrap_or_default();
        let figures: Vec<f64> = text.split_whitespace().filter_map(|word| word.parse().ok()).collect();
        if figures.len() == 9 && figures.iter().all(|figure| figure.abs() < 1e5) {
            latest = Some([0, 3, 6].map(|k| Vector3::new(figures[k], figures[k + 1], figures[k + 2])));
        }
    }
    latest
}
