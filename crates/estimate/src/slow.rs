//! The table of the slow states: forces on the helicopter and errors of its sensors. Each row states the means of a state, the
//! variance with which it starts and how it wanders.

use super::blocks::{Block, own};
use super::fitted::Learnt;
use super::models::Models;
use super::own::{COMPASS, Own, SECOND, SLOW_STATES, Senses};

/// What the walks depend on.
#[derive(Clone, Copy)]
pub(crate) struct Terms<'a> {
    pub(crate) models: &'a Models,
    pub(crate) learnt: &'a Learnt,
    pub(crate) senses: &'a Senses,
}

/// How a slow state moves.
enum Drift {
    /// A random walk, units per √s.
    Walk(f64),
    /// Gauss–Markov about zero: correlation time, s. Its variance is that it starts with.
    Reverts(fn(&Terms<'_>) -> f64),
}

/// A slow state of up to three components.
struct Slow {
    first: usize,
    mean: for<'a> fn(&'a mut Own) -> &'a mut [f64],
    start_var: fn(&Terms<'_>) -> [f64; 3],
    wander: Drift,
}

/// The slow states in the order of their columns.
const SLOW: [Slow; 23] = [
    Slow {
        first: place(own::GUST),
        mean: |own| own.gust.as_mut_slice(),
        start_var: |terms| [terms.learnt.gust_var; 3],
        wander: Drift::Reverts(|terms| terms.models.tau.gust_s),
    },
    Slow {
        first: place(own::THRUST),
        mean: |own| std::slice::from_mut(&mut own.thrust),
        start_var: |terms| [terms.learnt.thrust_var; 3],
        wander: Drift::Reverts(|terms| terms.models.tau.thrust_s),
    },
    Slow {
        first: place(own::TILT_ERROR),
        mean: |own| own.tilt_error.as_mut_slice(),
        start_var: |terms| [terms.learnt.tilt_error_var; 3],
        wander: Drift::Reverts(|terms| terms.senses.tilt_error_tau_s),
    },
    Slow {
        first: place(own::WIND),
        mean: |own| own.wind.as_mut_slice(),
        // 8 m/s of wind at a drag of 0.2 /s.
        start_var: |_| [1.5f64.powi(2); 3],
        wander: Drift::Walk(0.1),
    },
    Slow {
        first: place(own::TRIM),
        mean: |own| own.trim.as_mut_slice(),
        // 3.5°: a tail rotor alone makes a helicopter hang by some degrees.
        start_var: |_| [0.06f64.powi(2); 3],
        wander: Drift::Walk(1e-4),
    },
    Slow {
        first: place(own::GPS_BIAS),
        mean: |own| own.gps_bias.as_mut_slice(),
        start_var: |terms| terms.senses.gps_bias_var,
        wander: Drift::Reverts(|terms| terms.models.tau.gps_bias_s),
    },
    Slow {
        first: place(own::HEADING_BIAS),
        mean: |own| std::slice::from_mut(&mut own.heading_bias),
        start_var: |terms| [terms.models.heading_bias_var[COMPASS]; 3],
        // A tenth of a degree over 100 s would be 2e-4.
        wander: Drift::Walk(3e-4),
    },
    Slow {
        first: place(own::TILT_GAIN),
        mean: |own| std::slice::from_mut(&mut own.tilt_gain),
        // It is one, or found out beside the filter (`kind.rs`).
        start_var: |_| [0.0; 3],
        wander: Drift::Walk(0.0),
    },
    Slow {
        first: place(own::TILT_BIAS),
        mean: |own| own.tilt_bias.as_mut_slice(),
        // 0.4°: data sheets allow 0.2° to 0.5°.
        start_var: |_| [0.007f64.powi(2); 3],
        wander: Drift::Walk(3e-4),
    },
    Slow {
        first: place(own::GPS_DELAY),
        mean: |own| std::slice::from_mut(&mut own.gps_delay_s),
        start_var: |terms| [terms.models.gps_delay_var; 3],
        wander: Drift::Walk(2e-4),
    },
    Slow {
        first: place(own::DRAG),
        mean: |own| std::slice::from_mut(&mut own.drag_per_s),
        // About START_DRAG_PER_S.
        start_var: |_| [0.1f64.powi(2); 3],
        wander: Drift::Walk(1e-4),
    },
    Slow {
        first: place(own::COMPASS_DELAY),
        mean: |own| std::slice::from_mut(&mut own.compass_delay_s),
        // Filters of compasses and drivers of cameras have tens of milliseconds that no data sheet gives.
        start_var: |_| [0.03f64.powi(2); 3],
        wander: Drift::Walk(1e-4),
    },
    Slow {
        first: place(own::ARM),
        mean: |own| own.arm.as_mut_slice(),
        start_var: |_| [ARM_SIGMA_M * ARM_SIGMA_M; 3],
        wander: Drift::Walk(0.0),
    },
    Slow {
        first: place(own::LENS),
        mean: |own| &mut own.lens.as_mut_slice()[..2],
        // The others are as configured, until k1 is not (`lens.rs`).
        start_var: |_| [LENS_K1_SIGMA * LENS_K1_SIGMA, 0.0, 0.0],
        wander: Drift::Walk(0.0),
    },
    Slow {
        first: place(own::LENS.part::<2>(2)),
        mean: |own| &mut own.lens.as_mut_slice()[2..],
        start_var: |_| [0.0; 3],
        wander: Drift::Walk(0.0),
    },
    Slow {
        first: place(own::READOUT),
        mean: |own| std::slice::from_mut(&mut own.readout_s),
        // Global shutters have none, others some 10 to 30 ms.
        start_var: |_| [0.01f64.powi(2); 3],
        wander: Drift::Walk(0.0),
    },
    Slow {
        first: place(own::VELOCITY_DELAY),
        mean: |own| std::slice::from_mut(&mut own.velocity_delay_s),
        // Receivers filter velocity over some tenths of a second.
        start_var: |_| [0.1f64.powi(2); 3],
        wander: Drift::Walk(2e-4),
    },
    Slow {
        first: place(own::RATE_BIAS),
        mean: |own| own.rate_bias.as_mut_slice(),
        start_var: |terms| [terms.models.rate_bias_var; 3],
        wander: Drift::Walk(1e-4),
    },
    Slow {
        first: place(own::FORCE_BIAS),
        mean: |own| own.force_bias.as_mut_slice(),
        start_var: |terms| [terms.models.force_bias_var; 3],
        // What vibration rectifies changes with the load.
        wander: Drift::Walk(0.05),
    },
    Slow {
        first: place(own::SECOND_HEADING_BIAS),
        mean: |own| std::slice::from_mut(&mut own.second.heading_bias),
        start_var: |terms| [terms.models.heading_bias_var[SECOND]; 3],
        wander: Drift::Walk(3e-4),
    },
    Slow {
        first: place(own::SECOND_TILT_GAIN),
        mean: |own| std::slice::from_mut(&mut own.second.tilt_gain),
        start_var: |_| [0.0; 3],
        wander: Drift::Walk(0.0),
    },
    Slow {
        first: place(own::SECOND_TILT_BIAS),
        mean: |own| own.second.tilt_bias.as_mut_slice(),
        start_var: |_| [0.007f64.powi(2); 3],
        wander: Drift::Walk(3e-4),
    },
    Slow {
        first: place(own::SECOND_TILT_ERROR),
        mean: |own| own.second.tilt_error.as_mut_slice(),
        start_var: |terms| [terms.senses.second_error_var; 3],
        wander: Drift::Reverts(|terms| terms.senses.second_error_tau_s),
    },
];

/// How well an antenna's place is measured, m.
pub(crate) const ARM_SIGMA_M: f64 = 0.1;

/// How well k1 of a calibrated lens is known.
pub(crate) const LENS_K1_SIGMA: f64 = 0.02;

/// Drag at the start, 1/s: of a small rotorcraft 0.1 to 0.3 is usual, and every one has some.
pub(crate) const START_DRAG_PER_S: f64 = 0.2;

/// Where a block begins among the slow states.
const fn place<const N: usize>(block: Block<N>) -> usize {
    block.column(0) - own::SLOW.column(0)
}

impl Own {
    /// Gives each slow state, with its place among them, to a function.
    pub(crate) fn change_slow(&mut self, mut change: impl FnMut(usize, &mut f64)) {
        for slow in &SLOW {
            (slow.mean)(self).iter_mut().enumerate().for_each(|(i, mean)| change(slow.first + i, mean));
        }
    }
}

impl Terms<'_> {
    /// Variances that the slow states start with.
    pub(crate) fn start_vars(&self) -> [f64; SLOW_STATES] {
        by_row(|slow| (slow.start_var)(self))
    }

    /// Factors on the slow states' errors over a time: below one of those that revert.
    pub(crate) fn decays(&self, dt_s: f64) -> [f64; SLOW_STATES] {
        by_row(|slow| [slow.decay(self, dt_s); 3])
    }

    /// Variances that the slow states gain over a time.
    pub(crate) fn growth(&self, dt_s: f64) -> [f64; SLOW_STATES] {
        by_row(|slow| match slow.wander {
            Drift::Walk(walk) => [walk.powi(2) * dt_s; 3],
            Drift::Reverts(_) => {
                let decay = slow.decay(self, dt_s);
                (slow.start_var)(self).map(|var| var * (1.0 - decay * decay))
            }
        })
    }
}

impl Slow {
    fn decay(&self, terms: &Terms<'_>, dt_s: f64) -> f64 {
        match self.wander {
            Drift::Reverts(tau_s) => (-dt_s / tau_s(terms)).exp(),
            Drift::Walk(_) => 1.0,
        }
    }
}

fn by_row(values: impl Fn(&Slow) -> [f64; 3]) -> [f64; SLOW_STATES] {
    let mut all = [0.0; SLOW_STATES];
    for (k, slow) in SLOW.iter().enumerate() {
        let end = SLOW.get(k + 1).map_or(SLOW_STATES, |next| next.first);
        let row = values(slow);
        all[slow.first..end].copy_from_slice(&row[..end - slow.first]);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_every_slow_state_once_and_in_order() {
        let mut own = Own::default();
        let mut places = Vec::new();
        own.change_slow(|i, mean| {
            places.push(i);
            *mean = i as f64;
        });
        assert_eq!(places, (0..SLOW_STATES).collect::<Vec<_>>());
        assert_eq!(own.second.tilt_error.y, (SLOW_STATES - 1) as f64);
        assert_eq!(own.slow()[place(own::GPS_DELAY)], own.gps_delay_s);
    }
}
