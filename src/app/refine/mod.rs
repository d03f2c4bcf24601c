//! Refinement after the flight: a recorded flight is estimated as a whole, and the result is written beside it.

mod adopt;
mod beside;
mod outside;
mod words;
mod write;

pub use adopt::{adopted, too_many};
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
use windhover_base::msg::MarkerId;
use windhover_base::settings::TargetModel;
use windhover_estimate::Site;
use windhover_refine::{Recording, Refined, SurveyedMarker, refine};

/// Why a flight was not refined.
#[derive(Debug, thiserror::Error)]
pub enum RefineFlightError {
    /// It could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// Its configuration is missing or wrong.
    #[error(transparent)]
    Config(#[from] ReplayError),
    /// It has no processed measurements.
    #[error("{} is a capture: its measurements are not processed yet; make a flight of it with `windhover replay {0} --out FLIGHT.mcap`", path.display())]
    Bare {
        /// The recording.
        path: PathBuf,
    },
    /// Its place is not known.
    #[error("{}: there is no datum, because no three fixes of the receiver agreed; so there is no local frame for the refinement", path.display())]
    NoPlace {
        /// The flight.
        path: PathBuf,
    },
    /// Its measurements do not determine it.
    #[error("{}: {source}", path.display())]
    Refine {
        /// The flight.
        path: PathBuf,
        /// The reason.
        source: windhover_refine::RefineError,
    },
    /// A surveyed marker is not one of the configuration at rest.
    #[error("surveyed marker {id}: no target with model = \"static\" has a tag of this number")]
    Surveyed {
        /// Its number.
        id: u32,
    },
    /// External positions could not be read.
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
    /// The result.
    pub refined: Refined,
    /// Remarks on the flight for its reader.
    pub remarks: Vec<String>,
}

/// The default place of the result: `FLIGHT.refined.mcap` beside the flight.
pub fn beside(flight: &Path) -> PathBuf {
    let mut name = flight.file_stem().unwrap_or(flight.as_os_str()).to_owned();
    name.push(".refined.mcap");
    flight.with_file_name(name)
}

/// Refines flights over the same markers together: each has its own path, and they share the constants. The
/// configuration is that of the first flight. `positions` are external positions of the antenna, `surveyed` the numbers of
/// tags at rest with their positions and sigmas (m). `watch` gets the completed share, and returns whether to continue.
///
/// # Errors
/// Why the flights cannot be refined; nothing is written here.
pub fn refine_flights(
    paths: &[PathBuf],
    positions: Option<&Path>,
    surveyed: &[(u32, Geodetic, f64)],
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
    for (id, at, sigma_m) in surveyed {
        let marker = marker_at_rest(&config, *id).ok_or(RefineFlightError::Surveyed { id: *id })?;
        let surveyed = SurveyedMarker { marker, at: *at, sigma_m: *sigma_m };
        recordings.iter_mut().for_each(|recording| recording.surveyed.push(surveyed));
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

/// The tag of this number on a target that does not move.
fn marker_at_rest(config: &Config, id: u32) -> Option<MarkerId> {
    let targets = config.target.iter().filter(|target| target.model == TargetModel::Static);
    let tag = targets.flat_map(|target| &target.marker).find(|marker| marker.id == Some(id))?;
    Some(MarkerId::Tag { family: tag.family.unwrap_or_default(), id })
}

/// The part of the common result that belongs to one flight, in the frame of its own datum.
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
    /// Writes everything of the flight except its pictures, and the result. The file gets its name when it is complete.
    ///
    /// # Errors
    /// The flight cannot be read again, or the file not written.
    pub fn write(&self, from: &Path, to: &Path) -> Result<(), RefineFlightError> {
        write::write(self, from, to)
    }
}
