//! The flight afterwards: a recorded flight refined as a whole, and written beside it.

mod adopt;
mod beside;
mod outside;
mod words;
mod write;

pub use adopt::adopted;
pub use beside::RefinedBeside;
pub use words::{ConstantWords, constant_words, source_name};

use std::path::{Path, PathBuf};

use super::flight::Flight;
use super::replay::{ReplayError, config_of};
use super::{config_file, recording};
use crate::config::Config;
use crate::io::mcap_read::ReadError;
use crate::io::mcap_write::WriteError;
use crate::pipeline::{PipelineSettings, site_of};
use windhover_base::geo::{Geodetic, LocalFrame};
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
    /// Positions from outside could not be read.
    #[error(transparent)]
    Outside(#[from] outside::OutsideError),
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

/// Refines flights over the same markers together, each with a path of its own and constants that they share, by the
/// configuration of the first. `positions` are the antenna's from outside. `watch` gets the share that is done, and says
/// whether to go on.
///
/// # Errors
/// Why they cannot be refined; nothing is written here.
pub fn refine_flights(
    paths: &[PathBuf],
    positions: Option<&Path>,
    watch: &mut dyn FnMut(f64) -> bool,
) -> Result<Vec<RefinedFlight>, RefineFlightError> {
    let Some(first) = paths.first() else { return Ok(Vec::new()) };
    let config = config_of(first)?;
    let flights: Vec<Flight> = paths.iter().map(|path| Flight::read(path)).collect::<Result<_, _>>()?;
    let mut recordings: Vec<Recording> = flights.iter().map(recording::whole).collect();
    for ((path, flight), recording) in paths.iter().zip(&flights).zip(&recordings) {
        if recording.epochs.is_empty() && recording.readings.is_empty() && flight.reads > 0 {
            return Err(RefineFlightError::Bare { path: path.clone() });
        }
    }
    let site = site(first, &config, &flights[0], &recordings[0])?;
    if let Some(positions) = positions {
        outside::add_positions(positions, &mut recordings)?;
    }
    let refined = refine(&config.rig(), &config.filter(), &site, &recordings, watch)
        .map_err(|source| RefineFlightError::Refine { path: first.clone(), source })?;
    let done = flights.into_iter().enumerate().map(|(index, flight)| {
        let refined = of_flight(&refined, index, flight.datum);
        let remarks = words::remarks(&flight, &refined);
        RefinedFlight { flight, config: config.clone(), refined, remarks }
    });
    Ok(done.collect())
}

/// What of several flights is one's, in the frame of its own datum.
fn of_flight(all: &Refined, flight: usize, datum: Option<Geodetic>) -> Refined {
    let mut refined = all.clone();
    refined.own.retain(|(of, _)| *of == flight);
    refined.targets.retain(|(of, _)| *of == flight);
    refined.begins.retain(|(of, _)| *of == flight);
    refined.outliers.retain(|outlier| outlier.flight == flight);
    let Some(frame) = datum.filter(|_| flight > 0).map(LocalFrame::new) else { return refined };
    let ned = |lat_deg: f64, lon_deg: f64, height_m: f64| frame.ned(Geodetic { lat_deg, lon_deg, height_m });
    for (_, own) in &mut refined.own {
        own.position_ned_m = ned(own.lat_deg, own.lon_deg, own.height_m);
    }
    for state in refined.targets.iter_mut().filter_map(|(_, estimate)| estimate.state.as_mut()) {
        let place = ned(state.lat_deg, state.lon_deg, state.height_m);
        (state.north_m, state.east_m) = (place.x, place.y);
    }
    refined
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
