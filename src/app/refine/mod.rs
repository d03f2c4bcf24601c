//! The flight afterwards: a recorded flight refined as a whole, and written beside it.

mod adopt;
mod words;
mod write;

pub use adopt::adopted;
pub use words::{ConstantWords, constant_words, source_name};

use std::path::{Path, PathBuf};

use super::flight::Flight;
use super::replay::{ReplayError, config_of};
use super::{config_file, recording};
use crate::config::Config;
use crate::io::mcap_read::ReadError;
use crate::io::mcap_write::WriteError;
use crate::pipeline::{PipelineSettings, site_of};
use windhover_estimate::Site;
use windhover_refine::{Recording, Refined, refine};

/// Why a flight was not refined.
#[derive(Debug, thiserror::Error)]
pub enum RefineFlightError {
    /// It could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// Its configuration is missing or wrong.
    #[error(transparent)]
    Config(#[from] ReplayError),
    /// It holds no measurements that were looked at.
    #[error("{} is a capture: nothing in it was looked at yet; make a flight of it with `windhover replay {0} --out FLIGHT.mcap`", path.display())]
    Bare {
        /// The recording.
        path: PathBuf,
    },
    /// Where it took place is not known.
    #[error("{}: the receiver's fixes never settled on a place, so there is no frame to refine it in", path.display())]
    NoPlace {
        /// The flight.
        path: PathBuf,
    },
    /// Its measurements do not determine it.
    #[error("{}: {source}", path.display())]
    Refine {
        /// The flight.
        path: PathBuf,
        /// Why.
        source: windhover_refine::RefineError,
    },
    /// The result could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// A flight that was refined.
pub struct RefinedFlight {
    /// The flight as it was recorded.
    pub flight: Flight,
    /// Its configuration.
    pub config: Config,
    /// What was found.
    pub refined: Refined,
    /// Marks of the flight that a reader should know of.
    pub remarks: Vec<String>,
}

/// Where the result stands unless another place is named: `FLIGHT.refined.mcap` beside the flight.
pub fn beside(flight: &Path) -> PathBuf {
    let mut name = flight.file_stem().unwrap_or(flight.as_os_str()).to_owned();
    name.push(".refined.mcap");
    flight.with_file_name(name)
}

/// Refines a flight; `watch` gets the share that is done, and says whether to go on.
///
/// # Errors
/// Why it cannot be refined; nothing is written here.
pub fn refine_flight(
    path: &Path,
    watch: &mut dyn FnMut(f64) -> bool,
) -> Result<RefinedFlight, RefineFlightError> {
    let config = config_of(path)?;
    let flight = Flight::read(path)?;
    let recording = recording::whole(&flight);
    let looked_at = !(recording.epochs.is_empty() && recording.readings.is_empty());
    if !looked_at && flight.reads > 0 {
        return Err(RefineFlightError::Bare { path: path.to_owned() });
    }
    let site = site(path, &config, &flight, &recording)?;
    let recordings = std::slice::from_ref(&recording);
    let refined = refine(&config.rig(), &config.filter(), &site, recordings, watch)
        .map_err(|source| RefineFlightError::Refine { path: path.to_owned(), source })?;
    let remarks = words::remarks(&flight, &refined);
    Ok(RefinedFlight { flight, config, refined, remarks })
}

fn site(
    path: &Path,
    config: &Config,
    flight: &Flight,
    recording: &Recording,
) -> Result<Site, RefineFlightError> {
    let settings = PipelineSettings::from(config);
    let terrain = config_file::terrain_of(config, path);
    let epochs = recording.epochs.iter().map(|epoch| &epoch.value);
    let site = flight.datum.and_then(|datum| site_of(&settings, terrain, datum, epochs));
    site.ok_or_else(|| match recording.epochs.iter().any(|epoch| epoch.value.fix.has_position()) {
        true => RefineFlightError::NoPlace { path: path.to_owned() },
        false => {
            RefineFlightError::Refine { path: path.to_owned(), source: windhover_refine::RefineError::NoFix }
        }
    })
}

impl RefinedFlight {
    /// Writes everything of the flight but its pictures, and the result, to a file that stands in its place when it is whole.
    ///
    /// # Errors
    /// The flight cannot be read again, or the file not written.
    pub fn write(&self, from: &Path, to: &Path) -> Result<(), RefineFlightError> {
        write::write(self, from, to)
    }
}
