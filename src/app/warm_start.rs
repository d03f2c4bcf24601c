//! State that survives a restart: saved to the card once a second, restored at the start where it is fresh.

use std::time::Duration;

use prost::Message as _;

use super::context::TaskContext;
use super::flight_store::FlightStore;
use super::supervise::Heartbeat;
use crate::config::Config;
use crate::io::clock::HostClock;
use crate::io::process;
use crate::io::proto::{host_time, windhover};
use crate::io::records::warm_message;
use crate::io::store::{Recording, StoreHandle};
use windhover_base::msg::WarmState;
use windhover_base::time::{MonoTime, Span};

/// Its name among the states in the store.
const STATE: &str = "warm";

/// A state older than this is not used: the service manager restarts a daemon within seconds.
const OLDEST: Span = Span::from_ns(120_000_000_000);

/// Longest wait of the pipeline at the start for the card's answer. Events of the devices wait meanwhile in the queue,
/// which holds twice as much. The state is the first thing that is read from a card: only an extremely slow card, or an
/// index that another program holds, takes this long.
const PATIENCE: Span = Span::from_ns(5_000_000_000);

/// The card's answer about an earlier run.
#[derive(Debug)]
pub enum Earlier {
    /// Its state, and the age of it.
    Known(Box<WarmState>, Span),
    /// A state that must not be used.
    Unusable(Stale),
    /// None: there was none, nothing is recorded, or a stop was requested.
    Nothing,
    /// The card did not answer within this time.
    NoAnswer(Span),
}

/// Identity of this process: boot, program and configuration. A state must agree with it.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Origin {
    boot_id: Option<String>,
    host_from_monotonic: Span,
    config_crc: u32,
}

/// Why a state is not used.
#[derive(Clone, Copy, PartialEq, Debug, thiserror::Error)]
pub enum Stale {
    /// Not a state of this version of the program.
    #[error("it is not of this version")]
    Unreadable,
    /// The computer was rebooted; the clocks of two boots do not compare.
    #[error("the computer was rebooted since")]
    AnotherBoot,
    /// Its devices or mounts differ.
    #[error("the configuration was changed since")]
    AnotherConfiguration,
    /// It is too old, or from the future.
    #[error("it is {:.0} s old", .0.s())]
    Age(Span),
}

impl Origin {
    /// The identity of this process.
    pub fn here(config: &Config, clock: HostClock) -> Self {
        // A configuration that passed its checks can be written as TOML.
        let text = config.to_toml().unwrap_or_default();
        Self {
            boot_id: process::boot_id(),
            host_from_monotonic: clock.less_monotonic(),
            config_crc: crc32fast::hash(text.as_bytes()),
        }
    }

    /// A state of time `t`, as it is stored.
    pub fn sign(&self, t: MonoTime, state: &WarmState) -> Vec<u8> {
        let message = windhover::WarmState {
            boot_id: self.boot_id.clone().unwrap_or_default(),
            host_from_monotonic_ns: self.host_from_monotonic.ns(),
            config_crc: self.config_crc,
            ..warm_message::message(t, state)
        };
        message.encode_to_vec()
    }

    /// A stored state, on this process's clock, where it is fresh at `now`; and its age. The age is by the monotonic
    /// clock, so the computer's date may have been set in between.
    pub fn take_back(&self, kept: &[u8], now: MonoTime) -> Result<(WarmState, Span), Stale> {
        let message = windhover::WarmState::decode(kept).map_err(|_| Stale::Unreadable)?;
        let mut state = warm_message::state(&message).ok_or(Stale::Unreadable)?;
        if self.boot_id.as_deref() != Some(message.boot_id.as_str()) {
            return Err(Stale::AnotherBoot);
        }
        if self.config_crc != message.config_crc {
            return Err(Stale::AnotherConfiguration);
        }
        let moved_ns = self.host_from_monotonic.ns().wrapping_sub(message.host_from_monotonic_ns);
        let held_ns = host_time(message.timestamp.as_ref()).ns().wrapping_add(moved_ns);
        let age = Span::from_ns(now.ns().saturating_sub(held_ns));
        if age < Span::ZERO || age > OLDEST {
            return Err(Stale::Age(age));
        }
        for arrival in &mut state.arrivals {
            arrival.t_ns = arrival.t_ns.wrapping_add(moved_ns);
            arrival.offset_ns = arrival.offset_ns.wrapping_add(moved_ns);
        }
        if let Some(filter) = &mut state.filter {
            filter.t_ns = filter.t_ns.wrapping_add(moved_ns);
        }
        Ok((state, age))
    }
}

/// Gives the store a state to keep.
pub fn save(store: &StoreHandle, origin: &Origin, t: MonoTime, state: &WarmState) {
    store.put_state(STATE, origin.sign(t, state));
}

/// Waits for the card's answer about an earlier run.
pub fn wait_for(
    flight_store: &FlightStore,
    origin: &Origin,
    context: &TaskContext,
    heartbeat: &Heartbeat,
) -> Earlier {
    let end = context.clock.now() + PATIENCE;
    while !context.stop.is_cancelled() && context.clock.now() < end {
        heartbeat.beat();
        if let Some(store) = flight_store.get() {
            if let Some(index) = store.index() {
                let kept = index.state(STATE).map(|kept| origin.take_back(&kept, context.clock.now()));
                return match kept {
                    Some(Ok((state, age))) => Earlier::Known(Box::new(state), age),
                    Some(Err(stale)) => Earlier::Unusable(stale),
                    None => Earlier::Nothing,
                };
            }
            if matches!(store.status().recording, Recording::Stopped(_)) {
                return Earlier::Nothing;
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    if context.stop.is_cancelled() { Earlier::Nothing } else { Earlier::NoAnswer(PATIENCE) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::StoreConfig;
    use crate::io::store::Store;
    use crate::io::store::volume::Volume;
    use windhover_base::msg::{WarmArrival, WarmSite};

    fn origin() -> Origin {
        Origin { boot_id: Some("b".into()), host_from_monotonic: Span::from_s(1000.0), config_crc: 7 }
    }

    fn at(s: f64) -> MonoTime {
        MonoTime::default() + Span::from_s(s)
    }

    fn state() -> WarmState {
        let site =
            WarmSite { datum: [1.0, 2.0, 3.0], ground_height_m: 3.0, geoid_m: 0.0, declination_rad: 0.0 };
        let arrivals = vec![WarmArrival { t_ns: at(1999.0).ns(), offset_ns: at(1500.0).ns() }];
        WarmState { site, arrivals, filter: None }
    }

    #[test]
    fn a_fresh_state_is_taken_back_as_it_was() {
        let kept = origin().sign(at(2000.0), &state());
        assert_eq!(origin().take_back(&kept, at(2003.0)), Ok((state(), Span::from_s(3.0))));
    }

    #[test]
    fn a_clock_that_was_set_between_changes_nothing_but_the_scale() {
        let kept = origin().sign(at(2000.0), &state());
        let year = 31_536_000.0;
        let set = Origin { host_from_monotonic: Span::from_s(1000.0 + year), ..origin() };
        let (taken, age) = set.take_back(&kept, at(2003.0 + year)).expect("fresh");
        assert_eq!(age, Span::from_s(3.0));
        assert_eq!(taken.arrivals[0].t_ns, at(1999.0 + year).ns());
        assert_eq!(taken.arrivals[0].offset_ns, at(1500.0 + year).ns());
    }

    /// The card survives a reboot, the clock does not: it starts again, here at a minute.
    #[test]
    fn a_state_on_the_card_is_taken_by_the_next_run_of_this_boot_only() {
        let dir = tempfile::tempdir().expect("a scratch directory");
        let start = || {
            let path = dir.path().display().to_string();
            let config = StoreConfig { path, free_floor_mb: 0, free_target_mb: 0, ..StoreConfig::default() };
            let volume = Volume::new(dir.path());
            Store::start_on(volume, &config, String::new(), HostClock::start())
        };
        let kept = |store: &Store| store.handle().state(STATE, Duration::from_secs(30)).expect("it is kept");
        let (store, _notices) = start();
        save(&store.handle(), &origin(), at(1999.0), &state());
        save(&store.handle(), &origin(), at(2000.0), &state());
        store.stop();
        let (store, _notices) = start();
        let after_restart = kept(&store);
        assert_eq!(origin().take_back(&after_restart, at(2003.0)), Ok((state(), Span::from_s(3.0))));
        store.stop();
        let (store, _notices) = start();
        let booted =
            Origin { boot_id: Some("c".into()), host_from_monotonic: Span::from_s(2940.0), ..origin() };
        assert_eq!(booted.take_back(&kept(&store), at(3000.0)), Err(Stale::AnotherBoot));
        // States that this boot then saves belong to it, and the old state is gone.
        save(&store.handle(), &booted, at(3001.0), &state());
        store.stop();
        let (store, _notices) = start();
        assert_eq!(booted.take_back(&kept(&store), at(3004.0)).map(|(_, age)| age), Ok(Span::from_s(3.0)));
        assert_eq!(origin().take_back(&kept(&store), at(2003.0)), Err(Stale::AnotherBoot));
        store.stop();
    }

    #[test]
    fn what_is_old_or_of_another_boot_or_configuration_is_not_used() {
        let kept = origin().sign(at(2000.0), &state());
        let refused = |origin: Origin, now: f64| origin.take_back(&kept, at(now)).expect_err("refused");
        assert_eq!(refused(origin(), 2121.0), Stale::Age(Span::from_s(121.0)));
        assert_eq!(refused(origin(), 1999.0), Stale::Age(Span::from_s(-1.0)));
        assert_eq!(refused(Origin { boot_id: Some("c".into()), ..origin() }, 2003.0), Stale::AnotherBoot);
        assert_eq!(refused(Origin { boot_id: None, ..origin() }, 2003.0), Stale::AnotherBoot);
        assert_eq!(refused(Origin { config_crc: 8, ..origin() }, 2003.0), Stale::AnotherConfiguration);
        assert_eq!(origin().take_back(&[0xff; 20], at(2003.0)), Err(Stale::Unreadable));
    }
}
