//! The whole task graph on one page.
//!
//! ```text
//!   gps, pps ─┐                         ┌─► store   (card: flights, index)
//!   compass ──┼─► inbox ─► pipeline ────┼─► link    (ground stations, MAVLink)
//!   camera ───┘                         └─► board ◄── health (health line, watchdog, signals, power)
//!                         every task ─────► log     (journal, file)
//! ```
//!
//! | channel | holds | when full |
//! |---|---|---|
//! | inbox, frames | `daemon.frame_queue` frames, 16 in a burst of half a second | the oldest but the next one is dropped and recorded as dropped |
//! | inbox, reads | 8192 reads of the lines | the oldest is dropped and recorded as dropped |
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

use crate::config::Config;
use crate::io::clock::HostClock;
use crate::io::device::Stop;

use super::brain::{self, Board};
use super::card::{self, CardOrders, Slot};
use super::devices::{self, Surroundings};
use super::downlink::{self, Downlink};
use super::inbox::Inbox;
use super::log::Log;
use super::outlets;
use super::presence::Presence;
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
/// The wireless link.
pub const LINK: TaskRule = TaskRule { name: "link", restart: Restart::Retries };

/// The running graph, as its health task sees it.
pub struct Graph {
    /// What every task was given.
    pub around: Surroundings,
    /// Figures and health, shared with the pipeline's task.
    pub board: Board,
    /// What the card's task listens to.
    pub orders: CardOrders,
    /// The tasks.
    pub tasks: Supervisor,
}

/// Starts every task.
pub fn start(config: &Config, clock: HostClock, log: &Log) -> std::io::Result<Graph> {
    let around = Surroundings {
        clock,
        began: clock.now(),
        stop: Stop::default(),
        log: log.clone(),
        presence: Presence::default(),
        inbox: Arc::new(Inbox::new(config.daemon.frame_queue)),
    };
    let board = Board::default();
    board.with(|shown| shown.figures.link = "off".into());
    let mut tasks = Supervisor::new(clock);

    let (slot, orders) = (Slot::default(), CardOrders::default());
    let downlink = Downlink::new(config);
    {
        let (config, around, board) = (config.clone(), around.clone(), board.clone());
        let (slot, downlink) = (slot.clone(), downlink.clone());
        tasks.spawn(LINK, move |heart| downlink::run(&config, &around, &board, &slot, &downlink, &heart))?;
    }
    {
        let (config, around, board) = (config.clone(), around.clone(), board.clone());
        let (slot, orders) = (slot.clone(), orders.clone());
        let opened = card::open(&config, clock, &slot);
        tasks.spawn(STORE, move |heart| {
            card::run(&config, &around, &board, (&slot, opened), &orders, &heart);
        })?;
    }
    {
        let (config, around, board) = (config.clone(), around.clone(), board.clone());
        let outlets = (slot.clone(), outlets::of_daemon(&config, &slot, &downlink));
        let orders = orders.clone();
        tasks.spawn(PIPELINE, move |heart| brain::run(&config, &around, &board, outlets, &orders, &heart))?;
    }
    if config.gps.pps_device.is_some() {
        let (config, around) = (config.clone(), around.clone());
        tasks.spawn(PPS, move |heart| devices::pulses(&config, &around, &heart))?;
    }
    for (rule, device) in [
        (GPS, devices::gps as fn(&Config, &Surroundings, &super::supervise::Heart)),
        (COMPASS, devices::compass),
        (CAMERA, devices::camera),
    ] {
        let (config, around) = (config.clone(), around.clone());
        tasks.spawn(rule, move |heart| device(&config, &around, &heart))?;
    }
    Ok(Graph { around, board, orders, tasks })
}
