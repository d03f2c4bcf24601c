//! Deviations: how a flight may differ from its configuration, by name and amount.

use super::deviations::{COMPOSED, DEVIATIONS};
use super::scenario::Scenario;

/// One deviation from the configuration.
///
/// ```
/// use windhover_simulate::{Deviation, DeviationError, Scenario};
///
/// // A flight with three people in view and a tag that is 5 % larger than configured.
/// let scenario = Scenario::described("follow+people=3+tag-size=5").expect("both are within their limits");
/// assert_eq!(scenario.rig.target[0].marker[0].size_m, Some(0.48));
/// assert!(Deviation::named("tag-size").is_some_and(|deviation| deviation.limits.1 >= 5.0));
/// assert!(matches!(Scenario::described("follow+tag-size=1e9"), Err(DeviationError::OutOfLimits { .. })));
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Deviation {
    /// Its name.
    pub name: &'static str,
    /// Unit of its figure.
    pub unit: &'static str,
    /// Its effect, in one line.
    pub about: &'static str,
    /// Smallest and largest amount.
    pub limits: (f64, f64),
    /// The default amount.
    pub usual: f64,
    /// The scenario for a scenario of its name.
    pub shown_in: &'static str,
    /// The expected reaction of a pipeline.
    pub effect: Effect,
    pub(super) apply: fn(&mut Scenario, f64),
}

/// The expected reaction of a pipeline to a deviation.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Effect {
    /// The configuration is wrong in a harmful way: a misfit should be reported.
    Misfit,
    /// The configuration is wrong in a way that the filter's own states absorb: nothing to report.
    Absorbed,
    /// Nothing is wrong: other weather, or another instrument that is configured correctly.
    Condition,
}

/// Why a deviation is refused.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum DeviationError {
    /// The name does not exist.
    #[error("unknown deviation {0:?}")]
    Unknown(String),
    /// The scenario does not exist.
    #[error("unknown scenario {0:?}")]
    UnknownScenario(String),
    /// The text after the equals sign is not a number.
    #[error("{0:?} is not a number")]
    NoFigure(String),
    /// The amount is outside the limits.
    #[error("{name} = {value}: give {} to {} {unit}", limits.0, limits.1)]
    OutOfLimits {
        /// The deviation's name.
        name: &'static str,
        /// The amount.
        value: f64,
        /// Least and greatest.
        limits: (f64, f64),
        /// Their unit.
        unit: &'static str,
    },
}

/// A scenario made of another one and several deviations.
#[derive(Clone, Copy, Debug)]
pub(super) struct Composed {
    pub(super) name: &'static str,
    pub(super) about: &'static str,
    pub(super) base: &'static str,
    pub(super) deviations: &'static [(&'static str, f64)],
}

impl Effect {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Misfit => "misfit",
            Self::Absorbed => "absorbed",
            Self::Condition => "condition",
        }
    }
}

impl Deviation {
    /// Every deviation.
    pub fn all() -> &'static [Self] {
        DEVIATIONS
    }

    /// The deviation of this name.
    pub fn named(name: &str) -> Option<&'static Self> {
        DEVIATIONS.iter().find(|d| d.name == name)
    }
}

impl Scenario {
    /// Adds a deviation to the flight, of the default amount where none is given.
    ///
    /// # Errors
    /// Where `name` does not exist, or the amount is outside its limits.
    pub fn deviate(&mut self, name: &str, value: Option<f64>) -> Result<(), DeviationError> {
        let deviation = Deviation::named(name).ok_or_else(|| DeviationError::Unknown(name.to_owned()))?;
        let value = value.unwrap_or(deviation.usual);
        let (name, limits, unit) = (deviation.name, deviation.limits, deviation.unit);
        if !(limits.0..=limits.1).contains(&value) {
            return Err(DeviationError::OutOfLimits { name, value, limits, unit });
        }
        (deviation.apply)(self, value);
        Ok(())
    }

    /// The same from `NAME` or `NAME=FIGURE`.
    ///
    /// # Errors
    /// As [`Self::deviate`], and where the amount is not a number.
    pub fn deviate_as(&mut self, text: &str) -> Result<(), DeviationError> {
        let Some((name, figure)) = text.split_once('=') else { return self.deviate(text, None) };
        let value = figure.parse().map_err(|_| DeviationError::NoFigure(figure.to_owned()))?;
        self.deviate(name, Some(value))
    }

    /// A scenario with deviations, from `SCENARIO[+NAME[=FIGURE]]…`: `follow+people=3+wind=8`.
    ///
    /// # Errors
    /// Where a name does not exist or an amount is outside its limits.
    pub fn described(text: &str) -> Result<Self, DeviationError> {
        let mut parts = text.split('+');
        let name = parts.next().unwrap_or_default();
        let mut scenario =
            Self::named(name).ok_or_else(|| DeviationError::UnknownScenario(name.to_owned()))?;
        parts.try_for_each(|part| scenario.deviate_as(part))?;
        Ok(scenario)
    }

    /// The scenarios composed of another one and deviations: name and purpose. Each deviation is also a scenario under
    /// its own name.
    pub fn composed() -> impl Iterator<Item = (&'static str, &'static str)> {
        COMPOSED.iter().map(|c| (c.name, c.about))
    }

    /// The scenario of this name, which is a deviation or a composition.
    pub(super) fn deviating(name: &str) -> Option<Self> {
        let (about, base, deviations) = match COMPOSED.iter().find(|c| c.name == name) {
            Some(c) => (c.about, c.base, c.deviations.to_vec()),
            None => {
                let d = Deviation::named(name)?;
                (d.about, d.shown_in, vec![(d.name, d.usual)])
            }
        };
        let mut scenario = Self { name: name.to_owned(), about: about.to_owned(), ..Self::named(base)? };
        for (deviation, value) in deviations {
            scenario.deviate(deviation, Some(value)).expect("the table's amounts are within its limits");
        }
        Some(scenario)
    }
}
