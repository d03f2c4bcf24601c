//! The vocabulary of deviations: in what a flight may differ from what its configuration says, by name and figure.

use super::deviations::{COMPOSED, DEVIATIONS};
use super::scenario::Scenario;

/// One thing that may be otherwise than the configuration says.
#[derive(Clone, Copy, Debug)]
pub struct Deviation {
    /// Its name.
    pub name: &'static str,
    /// Unit of its figure.
    pub unit: &'static str,
    /// What it does, in a line.
    pub about: &'static str,
    /// Least and greatest figure.
    pub limits: (f64, f64),
    /// The figure where none is given.
    pub usual: f64,
    /// The scenario that shows it where it is asked for as one.
    pub shown_in: &'static str,
    /// What a pipeline should make of it.
    pub effect: Effect,
    pub(super) apply: fn(&mut Scenario, f64),
}

/// What a pipeline should make of a deviation.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Effect {
    /// The configuration is wrong in a way that harms: it should be told.
    Misfit,
    /// The configuration is wrong in a way that the filter's own states take up: nothing to tell.
    Absorbed,
    /// Nothing is wrong: other weather, another instrument of those that are configured for.
    Condition,
}

/// Why a deviation cannot be had.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum DeviationError {
    /// Nothing has this name.
    #[error("no deviation is called {0:?}")]
    Unknown(String),
    /// No scenario has this name.
    #[error("no scenario is called {0:?}")]
    UnknownScenario(String),
    /// What stands behind the equals sign is no number.
    #[error("{0:?} is no figure")]
    NoFigure(String),
    /// The figure lies outside the limits.
    #[error("{name} = {value}: give {} to {} {unit}", limits.0, limits.1)]
    OutOfLimits {
        /// Of what.
        name: &'static str,
        /// The figure.
        value: f64,
        /// Least and greatest.
        limits: (f64, f64),
        /// In which unit.
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
    /// Lets the flight differ from the configuration: by the figure that is usual where none is given.
    ///
    /// # Errors
    /// Where nothing is called `name`, or the figure lies outside its limits.
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
    /// As [`Self::deviate`], and where the figure is no number.
    pub fn deviate_as(&mut self, text: &str) -> Result<(), DeviationError> {
        let Some((name, figure)) = text.split_once('=') else { return self.deviate(text, None) };
        let value = figure.parse().map_err(|_| DeviationError::NoFigure(figure.to_owned()))?;
        self.deviate(name, Some(value))
    }

    /// A scenario with deviations, from `SCENARIO[+NAME[=FIGURE]]…`: `follow+people=3+wind=8`.
    ///
    /// # Errors
    /// Where a name is not known or a figure not within its limits.
    pub fn described(text: &str) -> Result<Self, DeviationError> {
        let mut parts = text.split('+');
        let name = parts.next().unwrap_or_default();
        let mut scenario =
            Self::named(name).ok_or_else(|| DeviationError::UnknownScenario(name.to_owned()))?;
        parts.try_for_each(|part| scenario.deviate_as(part))?;
        Ok(scenario)
    }

    /// The scenarios that are made of another one and deviations: name and purpose. Each deviation is one too, under its
    /// own name.
    pub fn composed() -> impl Iterator<Item = (&'static str, &'static str)> {
        COMPOSED.iter().map(|c| (c.name, c.about))
    }

    /// The scenario that this name means as a deviation or a composition.
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
            scenario.deviate(deviation, Some(value)).expect("the table's figures lie within its limits");
        }
        Some(scenario)
    }
}
