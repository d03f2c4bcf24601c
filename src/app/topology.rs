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
//! | gps, compass | their line's descriptor | open the device again, waiting ¼ s to 5 s |
//! | autopilot | its line or socket, frames for it, a second's timer | the same |
//! | pps | the pulse device's descriptor | the same |
//! | camera | the V4L2 queue's descriptor, or the thread that plays a recording | the same |
//! | power | the GPIO line's descriptor, a second's timer | the same |
//! | store | notices of the store, the pipeline's end, power going | opens the card again; the daemon flies on without |
//! | link | its socket | calls again; the daemon flies on without |
//! | metrics | its port on loopback, where one is configured | the port again; the daemon flies on without |
//! | health | signals, the end of any task, a quarter-second timer | is the main thread; nothing restarts it |
//!
//! Threads of their own, and why:
//!
//! | thread | why |
//! |---|---|
//! | pipeline | computes for milliseconds a frame. Ends the process where it fails: a filter in an unknown state is not repaired |
//! | store-encode | computes JPEG |
//! | video, where it is configured | computes H.264; of lower priority than all others |
//! | store-write, store-keep, index | `fdatasync` and directory calls block as long as the card does |
//! | log, one for each sink | a terminal, a pipe, a journal or a disk can stall |
//! | recording | reads image files where the camera is a recording; it stands in for the driver |
//! | runtime's threads for blocking work, 32 at most | open and close devices (a UART drains, a camera ends its stream); read configuration, terrain, keys and sysfs; thumbnails; back-fill from the card; start and stop the store |
//!
//! The main thread strokes the watchdog and answers signals, and runs nothing else: a configuration and its terrain
//! are read on a thread for blocking work, at the start and on SIGHUP.
//!
//! | channel | holds | when full |
//! |---|---|---|
//! | event queue, frames | `daemon.frame_queue` frames, 16 in a burst of half a second | the oldest but the next one is dropped and recorded as dropped; so is one whose turn comes half a second late (two seconds, where the pipeline had none for five) |
//! | event queue, reads | 8192 reads of the lines | the oldest is dropped and recorded as dropped |
//! | recording to camera | 12 frames, as a driver's buffers | the recording waits |
//! | store | see `io::store` | what does not fit is dropped and counted; the pipeline never waits |
//! | link | see `io::link` | the oldest estimate goes first; what was missed is sent later |
//! | MAVLink to autopilot | 64 frames | the oldest is dropped |
//! | video | one frame, 2048 records | a newer frame replaces it; the oldest record is dropped |
//! | power to health, power to store, store to link | the newest value | a newer value replaces it |
//! | log, each sink | 512 lines | the line is dropped and counted |
//!
//! Every task beats its heart at least once a second while it works; the watchdog is stroked only while
//! all do. A panic in any task ends the process, and the service manager starts it again. The end is a
//! cancellation token: the device tasks are dropped where they wait, the pipeline handles what is queued, the
//! store closes the flight.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;

use crate::io::autopilot::ToAutopilot;
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
/// Supply, temperature, and the line that tells of power going.
pub const POWER: TaskRule = TaskRule { name: "power", restart: Restart::Retries };
/// The link to the autopilot, where it is heard.
pub const AUTOPILOT: TaskRule = TaskRule { name: "autopilot", restart: Restart::Retries };
/// The wireless link.
pub const LINK: TaskRule = TaskRule { name: "link", restart: Restart::Retries };

/// Answers on loopback, where they are configured.
pub const METRICS: TaskRule = TaskRule { name: "metrics", restart: Restart::Retries };

/// The camera's picture with its metadata, where it is configured.
pub const VIDEO: TaskRule = TaskRule { name: "video", restart: Restart::Retries };

/// The running graph, as its health task sees it.
pub struct Graph {
    /// What every task was given.
    pub context: TaskContext,
    /// Figures and health, shared with the other tasks.
    pub status: SharedStatus,
    /// What the store's task is asked to do.
    pub orders: StoreOrders,
    /// What the power task reads.
    pub power: PowerView,
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

    tasks.spawn(LINK, |heart| {
        let (config, context, status) = (Arc::clone(&config), context.clone(), status.clone());
        let (flight_store, downlink) = (flight_store.clone(), downlink.clone());
        downlink::run(LinkTask { config, context, status, flight_store, downlink, heart })
    });
    let opened = card::open(&config, clock, &flight_store);
    tasks.spawn(STORE, |heart| {
        let (config, context, status) = (Arc::clone(&config), context.clone(), status.clone());
        let (flight_store, orders) = (flight_store.clone(), orders.clone());
        card::run(StoreTask { config, context, status, flight_store, orders, heart }, opened)
    });
    if config.video.is_on() {
        let (config, context) = (Arc::clone(&config), context.clone());
        let (queue, flight_store) = (video.clone(), flight_store.clone());
        let run = |heart| video_task::run(VideoTask { config, context, queue, flight_store, heart });
        tasks.spawn_thread(VIDEO, run)?;
    }
    tasks.spawn_thread(PIPELINE, {
        let (config, context, status) = (Arc::clone(&config), context.clone(), status.clone());
        let outlets = outlets::of_daemon(&config, &flight_store, &downlink, &metrics, &video);
        let orders = orders.clone();
        move |heart| {
            let parts = Parts { config, terrain, context, status, flight_store, outlets, orders, heart };
            pipeline_task::run(parts);
        }
    })?;
    let (readings, power) = power_task::parts(&config.power);
    tasks.spawn(POWER, |heart| power_task::run(readings, context.clone(), heart));
    if let Some(device) = config.gps.pps_device.clone() {
        tasks.spawn(PPS, |heart| devices::pulses(device, context.clone(), heart));
    }
    if config.gps.is_there() {
        tasks.spawn(GPS, |heart| devices::gps(Arc::clone(&config), context.clone(), heart));
    }
    if config.compass.is_there() && !shares_line(&config.gps, &config.compass) {
        tasks.spawn(COMPASS, |heart| devices::compass(Arc::clone(&config), context.clone(), heart));
    }
    if config.autopilot.is_some() {
        let (config, context, to_autopilot) = (Arc::clone(&config), context.clone(), to_autopilot.clone());
        tasks.spawn(AUTOPILOT, |heart| devices::autopilot(config, to_autopilot, context, heart));
    }
    if let Some(address) = config.daemon.metrics {
        tasks.spawn(METRICS, |heart| metrics_task::run(address, metrics, context.clone(), heart));
    }
    tasks.spawn(CAMERA, |heart| devices::camera(Arc::clone(&config), context.clone(), heart));
    Ok(Graph { context, status, orders, power, tasks })
}
