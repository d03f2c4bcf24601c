//! `windhover calibrate boresight`

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde_json::json;

use crate::app::flight::Flight;
use crate::app::{config_file, declination, recording};
use crate::cli::out::outln;
use crate::cli::surveyed::SurveyedArgs;
use crate::cli::{CliError, CliResult};
use crate::config::Config;
use windhover_base::geo::Geodetic;
use windhover_base::msg::MarkerId;
use windhover_base::msg::TagFamily;
use windhover_calibrate::boresight::{Boresight, Finding, boresight};

/// Calibrate mounting and timing of camera and compass, from flights over markers at rest.
///
/// Flights must have the pipeline's detections: replay a capture first. Markers are those of static targets of the
/// configuration, or all where no target is static. Uncertainties are one sigma.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover calibrate boresight flight.mcap
  windhover calibrate boresight a.mcap b.mcap --surveyed 7:30.069604785,-85.575391587,6.0

Quantities that the flights do not determine are marked, with the manoeuvre that would determine them.")]
pub(super) struct Args {
    /// Flights: files, or directories of segments
    #[arg(required = true, value_name = "FLIGHT")]
    flights: Vec<PathBuf>,
    /// Configuration; the one attached to the first flight where absent
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    surveyed: SurveyedArgs,
    /// One JSON object on standard output
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> CliResult {
    let flights: Vec<Flight> = args.flights.iter().map(|p| Flight::read(p)).collect::<Result<_, _>>()?;
    for (path, flight) in args.flights.iter().zip(&flights) {
        if flight.detections.is_empty() && !flight.frames.is_empty() {
            return Err(CliError::failed(format!(
                "{} is a capture: replay it first (windhover replay {0} --out FLIGHT.mcap)",
                path.display()
            )));
        }
    }
    let config = match (&args.config, flights.first().and_then(|f| f.config.clone())) {
        (Some(path), _) => config_file::load(path).map_err(CliError::config)?,
        (None, Some(config)) => config,
        (None, None) => {
            return Err(CliError::usage("the flight has no configuration: give --config FILE"));
        }
    };
    let first = flights.first().ok_or_else(|| CliError::usage("no flight was given"))?;
    let declination = declination::of_flight(&config.compass, first)?;
    let recordings: Vec<_> = flights.iter().map(recording::recording).collect();
    let surveyed = surveyed_markers(args, &config);
    let found = boresight(&config.rig(), declination, &recordings, &surveyed).map_err(CliError::failed)?;
    if args.json {
        outln!("{}", as_json(&found))?;
    } else {
        print_text(&found, &config)?;
    }
    Ok(())
}

fn surveyed_markers(args: &Args, config: &Config) -> BTreeMap<MarkerId, (Geodetic, f64)> {
    let family_of = |id: u32| -> TagFamily {
        let markers = config.target.iter().flat_map(|t| &t.marker);
        markers.filter(|m| m.id == Some(id)).find_map(|m| m.family).unwrap_or_default()
    };
    let entry = |(id, at, sigma_m)| (MarkerId::Tag { family: family_of(id), id }, (at, sigma_m));
    args.surveyed.tags().into_iter().map(entry).collect()
}

fn as_json(found: &Boresight) -> serde_json::Value {
    let finding = |f: &Finding| json!({"name": f.name, "unit": f.unit, "value": f.value, "sigma": f.sigma, "prior": f.prior, "told": f.determined});
    let markers: Vec<_> = found
        .markers
        .iter()
        .map(|m| {
            json!({
                "marker": name_of(m.marker), "flight": m.flight, "lat_deg": m.position.lat_deg,
                "lon_deg": m.position.lon_deg, "height_m": m.position.height_m,
                "sigma_ned_m": m.sigma_m.as_slice(),
            })
        })
        .collect();
    json!({
        "parameters": found.parameters.iter().map(finding).collect::<Vec<_>>(),
        "camera_to_compass": found.camera_to_compass.iter().map(finding).collect::<Vec<_>>(),
        "markers": markers,
        "rms_px": found.rms_px,
        "pixels": found.pixels,
        "refused": found.refused,
        "advice": found.advice(),
    })
}

fn name_of(marker: MarkerId) -> String {
    match marker {
        MarkerId::Tag { family, id } => format!("{} {id}", family.name()),
        MarkerId::Disc { target, marker } => format!("disc {target}.{marker}"),
    }
}

fn print_text(found: &Boresight, config: &Config) -> CliResult {
    outln!("{} pixel coordinates, residual {:.3} px (root mean square)", found.pixels, found.rms_px)?;
    if found.refused > 0 {
        outln!("{} measurements were outside the gate and were left out", found.refused)?;
    }
    outln!("\n                         value  one sigma")?;
    for f in &found.parameters {
        let note = if f.determined { "" } else { "   not determined by these flights" };
        outln!("{:<20} {:>9.3} {:>9.3} {:<3}{note}", f.name, f.value, f.sigma, f.unit)?;
    }
    outln!("\ncamera relative to compass (which determines a vehicle's position)")?;
    for f in &found.camera_to_compass {
        outln!("{:<20} {:>9.3} {:>9.3} {}", f.name, f.value, f.sigma, f.unit)?;
    }
    for m in &found.markers {
        outln!(
            "\nmarker {} (flight {}): {:.9} {:.9} {:.2} m, one sigma north {:.2} east {:.2} down {:.2} m",
            name_of(m.marker),
            m.flight,
            m.position.lat_deg,
            m.position.lon_deg,
            m.position.height_m,
            m.sigma_m.x,
            m.sigma_m.y,
            m.sigma_m.z
        )?;
    }
    for advice in found.advice() {
        outln!("\n{advice}")?;
    }
    let value = |k: usize| found.parameters[k].value;
    outln!("\n[camera.mount]")?;
    outln!("position_m = [{:.3}, {:.3}, {:.3}]", value(3), value(4), value(5))?;
    outln!("yaw_deg = {:.3}\npitch_deg = {:.3}\nroll_deg = {:.3}", value(0), value(1), value(2))?;
    outln!("\n[compass]")?;
    outln!("yaw_offset_deg = {:.3}", config.compass.yaw_offset_deg - value(6))?;
    outln!("pitch_offset_deg = {:.3}", config.compass.pitch_offset_deg + value(7))?;
    outln!("roll_offset_deg = {:.3}", config.compass.roll_offset_deg + value(8))?;
    outln!("latency_ms = {:.1}", config.compass.latency_ms + value(9))?;
    outln!("\n[gps]\nlatency_ms = {:.1}", config.gps.latency_ms + value(10))?;
    Ok(())
}
