//! The whole task graph on one page.
//!
//! ```text
//!   gps, pps ─┐                         ┌─► store   (card: flights, index)
//!   compass ──┼─► events ─► pipeline ────┼─► link    (ground stations, MAVLink)
//!   camera ───┘                         └─► status ◄── health (health line, watchdog, signals, power)
//!                         every task ─────► log     (journal, file)
//! ```
//!
//! | channel | holds | when full |
//! |---|---|---|
//! | events, frames | `daemon.frame_queue` frames, 16 in a burst of half a second | the oldest but the next one is dropped and recorded as dropped |
//! | events, reads | 8192 reads of the lines | the oldest is dropped and recorded as dropped |
//! | store | see `io::store` | what does not fit is dropped and counted; the pipeline never waits |
//! | link | see `io::link` | the oldest estimate goes first; what was missed is sent later |
//! | log | 512 lines | the line is dropped and counted |
//!
//! | task | restart rule |
//! |---|---|
//! | gps, pps, compass, camera | open the device again, waiting ¼ s to 5 s |
//! | pipeline | ends the process: a filter in an unknown state is not repaired |
//! | store | opens the card again; the daemon flies on without |
//! | link | calls again; the daemon flies on without |
//! | health | is the main thread: signals, health, watchdog |
//!
//! Every task beats its heart at least once a second while it works; the watchdog is stroked only while
//! all do. A panic in any task ends the process, and the service manager starts it again.

use std::sync::Arc;

use tokio_util::sync::CancellationToken;

use crate::io::clock::HostClock;

use super::card::{self, StoreTask};
use super::config_file::Loaded;
use super::context::TaskContext;
use super::devices;
use super::downlink::{self, Downlink, LinkTask};
use super::event_queue::EventQueue;
use super::flight_store::{FlightStore, StoreOrders};
use super::log::Log;
use super::outlets::Outlets;
use super::pipeline_task::{self, Parts};
use super::power_task::{self, PowerView};
use super::presence::Presence;
use super::status::SharedStatus;
use super::supervise::{Restart, Supervisor, TaskRule};

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
/// The wireless link.
pub const LINK: TaskRule = TaskRule { name: "link", restart: Restart::Retries };

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
pub fn start(loaded: Loaded, clock: HostClock, log: &Log) -> std::io::Result<Graph> {
    let (config, terrain) = (Arc::new(loaded.config), loaded.terrain);
    let context = TaskContext {
        clock,
        began: clock.now(),
        stop: CancellationToken::new(),
        log: log.clone(),
        presence: Presence::default(),
        events: Arc::new(EventQueue::new(config.daemon.frame_queue)),
    };
    let status = SharedStatus::default();
    status.with(|status| status.figures.link = "off".into());
    let (flight_store, orders) = (FlightStore::default(), StoreOrders::default());
    let downlink = Downlink::new(&config);
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
    tasks.spawn_thread(PIPELINE, {
        let (config, context, status) = (Arc::clone(&config), context.clone(), status.clone());
        let (outlets, orders) = (Outlets::new(&config, flight_store, downlink), orders.clone());
        move |heart| {
            pipeline_task::run(Parts { config, terrain, context, status, outlets, orders, heart });
        }
    })?;
    let (readings, power) = power_task::parts(&config.power);
    tasks.spawn(POWER, |heart| power_task::run(readings, context.clone(), heart));
    if let Some(device) = config.gps.pps_device.clone() {
        tasks.spawn(PPS, |heart| devices::pulses(device, context.clone(), heart));
    }
    tasks.spawn(GPS, |heart| devices::gps(Arc::clone(&config), context.clone(), heart));
    tasks.spawn(COMPASS, |heart| devices::compass(Arc::clone(&config), context.clone(), heart));
    tasks.spawn(CAMERA, |heart| devices::camera(Arc::clone(&config), context.clone(), heart));
    Ok(Graph { context, status, orders, power, tasks })
}
