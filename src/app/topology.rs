//! The whole task graph on one page.
//!
//! ```text
//!   gps, pps ─┐                                  ┌─► store   (card: flights, index)
//!   compass ──┼─► event queue ─► pipeline ───────┼─► link    (ground stations, MAVLink)
//!   camera ───┤                                  │   autopilot (frames for it)
//! autopilot ──┘                                  └─► status ◄── health (health line, watchdog, signals)
//!   power ─────────────────────────────────────────────────────► health
//!                         every task ─────► log     (journal, file)
//! ```
//!
//! Tasks of the one runtime, which has two workers. They wait by readiness and never block:
//!
//! | task | waits for | restart rule |
//! |---|---|---|
//! | gps, compass | their line's descriptor | reopens the device, with pauses of ¼ s to 5 s |
//! | autopilot | its line or socket, frames for it, a second's timer | the same |
//! | pps | the pulse device's descriptor | the same |
//! | trigger | the descriptor of the GPIO line that triggers the camera | the same |
//! | camera | the V4L2 queue's descriptor, or the thread that plays a recording | the same |
//! | power | the GPIO line's descriptor, a second's timer | the same |
//! | store | notices of the store, the pipeline's end, power failure | reopens the card; the daemon continues without
//! it |
//! | link | its socket | reopens the socket; the daemon continues without it |
//! | metrics | its port on loopback, where one is configured | reopens the port; the daemon continues without it |
//! | health | signals, the end of any task, a quarter-second timer | the main thread; nothing restarts it |
//!
//! Tasks with their own threads, and the reasons:
//!
//! | thread | why |
//! |---|---|
//! | pipeline | computes for milliseconds in each frame. A failure ends the process: a filter in an unknown state is
//! not repaired |
//! | store-encode | computes JPEG |
//! | video, where it is configured | computes H.264; of lower priority than all others |
//! | store-write, store-keep, index | `fdatasync` and directory calls block as long as the card does |
//! | log, one for each sink | a terminal, a pipe, a journal or a disk can stall |
//! | recording | reads image files where the camera is a recording; it replaces the driver |
//! | runtime's threads for blocking work, 32 at most | open and close devices (a UART drains, a camera ends its stream); read configuration, terrain, keys and sysfs; thumbnails; back-fill from the card; start and stop the store |
//!
//! The main thread notifies the watchdog and handles signals, and runs nothing else: a configuration and its terrain
//! are read on a thread for blocking work, at the start and on SIGHUP.
//!
//! | channel | holds | when full |
//! |---|---|---|
//! | event queue, frames | `daemon.frame_queue` frames, 16 in a burst of half a second | the oldest except the next one
//! is dropped and recorded as dropped; so is one whose turn comes half a second late (two seconds, where the pipeline
//! had none for five) |
//! | event queue, reads | 8192 reads of the lines | the oldest is dropped and recorded as dropped |
//! | recording to camera | 12 frames, as a driver's buffers | the recording waits |
//! | store | see `io::store` | the excess is dropped and counted; the pipeline never waits |
//! | link | see `io::link` | the oldest estimate is dropped first; missed records are sent later |
//! | MAVLink to autopilot | 64 frames | the oldest is dropped |
//! | video | one frame, 2048 records | a newer frame replaces it; the oldest record is dropped |
//! | power to health, power to store, store to link | the newest value | a newer value replaces it |
//! | log, each sink | 512 lines | the line is dropped and counted |
//!
//! Every task has a heartbeat at least once a second while it works; the watchdog is notified only while all tasks
//! answer. A panic in any task ends the process, and the service manager restarts it. A stop is a cancellation token:
//! the device tasks are dropped where they wait, the pipeline handles the queued events, the store closes the flight.

use std::sync::{Arc, Mutex};

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::io::autopilot::ToAutopilot;
use crate::io::camera::{CameraInputs, ExposureSettings, TriggerCount};
use crate::io::clock::HostClock;
use windhover_base::settings::shares_line;

use super::card::{self, StoreTask};
use super::config_file::Loaded;
use super::context::TaskContext;
use super::devices;
use super::downlink::{self, Downlink, LinkTask};
use super::event_queue::EventQueue;
use super::flight_store::{FlightStore, StoreOrders};
use super::metrics_task;
use super::outlets;
use super::pipeline_task::{self, Parts};
use super::power_task::{self, PowerView};
use super::presence::Presence;
use super::sinks::{LatestHealth, VideoQueue};
use super::status::SharedStatus;
use super::supervise::{Restart, Supervisor, TaskRule};
use super::video_task::{self, VideoTask};

/// The GPS line.
pub const GPS: TaskRule = TaskRule { name: "gps", restart: Restart::Retries };
/// The compass line.
pub const COMPASS: TaskRule = TaskRule { name: "compass", restart: Restart::Retries };
/// The camera.
pub const CAMERA: TaskRule = TaskRule { name: "camera", restart: Restart::Retries };
/// Events to outputs.
pub const PIPELINE: TaskRule = TaskRule { name: "pipeline", restart: Restart::EndsProcess };
/// The data card.
pub const STORE: TaskRule = TaskRule { name: "store", restart: Restart::Retries };
/// The receiver's pulse, where one is configured.
pub const PPS: TaskRule = TaskRule { name: "pps", restart: Restart::Retries };
/// The line that triggers the camera, where one is configured.
pub const TRIGGER: TaskRule = TaskRule { name: "trigger", restart: Restart::Retries };
/// Supply, temperature, and the line that signals a power failure.
pub const POWER: TaskRule = TaskRule { name: "power", restart: Restart::Retries };
/// The connection to the autopilot, where one is configured.
pub const AUTOPILOT: TaskRule = TaskRule { name: "autopilot", restart: Restart::Retries };
/// The wireless link.
pub const LINK: TaskRule = TaskRule { name: "link", restart: Restart::Retries };

/// Metrics on loopback, where configured.
pub const METRICS: TaskRule = TaskRule { name: "metrics", restart: Restart::Retries };

/// The camera's picture with its metadata, where it is configured.
pub const VIDEO: TaskRule = TaskRule { name: "video", restart: Restart::Retries };

/// The running graph, for its health task.
pub struct Graph {
    /// The context of every task.
    pub context: TaskContext,
    /// Values and health, shared with the other tasks.
    pub status: SharedStatus,
    /// Requests to the store's task.
    pub orders: StoreOrders,
    /// The power task's readings.
    pub power: PowerView,
    /// Requests to the camera about its exposure.
    pub exposure: watch::Sender<ExposureSettings>,
    /// The tasks.
    pub tasks: Supervisor,
}

/// Starts every task.
pub fn start(loaded: Loaded, clock: HostClock) -> std::io::Result<Graph> {
    let (config, terrain) = (Arc::new(loaded.config), loaded.terrain);
    let context = TaskContext {
        clock,
        began: clock.now(),
        stop: CancellationToken::new(),
        presence: Presence::default(),
        events: Arc::new(EventQueue::new(config.daemon.frame_queue)),
    };
    let status = SharedStatus::default();
    status.with(|status| status.figures.link = "off".into());
    let (flight_store, orders) = (FlightStore::default(), StoreOrders::default());
    let to_autopilot = ToAutopilot::default();
    let downlink = Downlink::new(&config, &to_autopilot);
    let (metrics, video) = (LatestHealth::default(), VideoQueue::default());
    let mut tasks = Supervisor::new(clock);

    tasks.spawn(LINK, |heartbeat| {
        let (config, context, status) = (Arc::clone(&config), context.clone(), status.clone());
        let (flight_store, downlink) = (flight_store.clone(), downlink.clone());
        downlink::run(LinkTask { config, context, status, flight_store, downlink, heartbeat })
    });
    let opened = card::open(&config, clock, &flight_store);
    tasks.spawn(STORE, |heartbeat| {
        let (config, context, status) = (Arc::clone(&config), context.clone(), status.clone());
        let (flight_store, orders) = (flight_store.clone(), orders.clone());
        card::run(StoreTask { config, context, status, flight_store, orders, heartbeat }, opened)
    });
    if config.video.is_on() {
        let (config, context) = (Arc::clone(&config), context.clone());
        let (queue, flight_store) = (video.clone(), flight_store.clone());
        let run = |heartbeat| {
            video_task::run(VideoTask { config, context, queue, flight_store, heartbeat });
        };
        tasks.spawn_thread(VIDEO, run)?;
    }
    tasks.spawn_thread(PIPELINE, {
        let (config, context, status) = (Arc::clone(&config), context.clone(), status.clone());
        let outlets = outlets::of_daemon(&config, &flight_store, &downlink, &metrics, &video);
        let orders = orders.clone();
        move |heartbeat| {
            let parts = Parts { config, terrain, context, status, flight_store, outlets, orders, heartbeat };
            pipeline_task::run(parts);
        }
    })?;
    let (readings, power) = power_task::parts(&config.power);
    tasks.spawn(POWER, |heartbeat| power_task::run(readings, context.clone(), heartbeat));
    if let Some(device) = config.gps.pps_device.clone() {
        tasks.spawn(PPS, |heartbeat| devices::pulses(device, context.clone(), heartbeat));
    }
    if config.gps.is_there() {
        tasks.spawn(GPS, |heartbeat| devices::gps(Arc::clone(&config), context.clone(), heartbeat));
    }
    if config.compass.is_there() && !shares_line(&config.gps, &config.compass) {
        tasks.spawn(COMPASS, |heartbeat| devices::compass(Arc::clone(&config), context.clone(), heartbeat));
    }
    if config.autopilot.is_some() {
        let (config, context, to_autopilot) = (Arc::clone(&config), context.clone(), to_autopilot.clone());
        tasks.spawn(AUTOPILOT, |heartbeat| devices::autopilot(config, to_autopilot, context, heartbeat));
    }
    if let Some(address) = config.daemon.metrics {
        tasks.spawn(METRICS, |heartbeat| metrics_task::run(address, metrics, context.clone(), heartbeat));
    }
    let (exposure, wanted) = watch::channel(devices::exposure(&config.camera));
    let mut inputs = CameraInputs { exposure: wanted, trigger: None };
    if let Some(line) = config.camera.trigger_line.clone() {
        let count = Arc::<Mutex<TriggerCount>>::default();
        inputs.trigger = Some(Arc::clone(&count));
        tasks.spawn(TRIGGER, |heartbeat| devices::trigger(line, count, context.clone(), heartbeat));
    }
    let camera = |heartbeat| devices::camera(Arc::clone(&config), inputs, context.clone(), heartbeat);
    tasks.spawn(CAMERA, camera);
    Ok(Graph { context, status, orders, power, exposure, tasks })
}
