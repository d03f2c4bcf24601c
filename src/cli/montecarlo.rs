//! `windhover montecarlo`

use std::path::{Path, PathBuf};

use serde_json::json;

use super::{CliError, CliResult, place};
use crate::app::flight::Flight;
use crate::app::truth::Truth;
use crate::app::{config_file, declination, geopositions};
use crate::cli::out::outln;
use crate::config::Config;
use crate::io::new_file::Inputs;
use crate::plot;
use crate::plot::montecarlo::{Overlay, scatter_svg};
use windhover_calibrate::montecarlo::{Analysis, Setup, radii};

/// The configuration shipped with the program: the paper's camera.
const SHIPPED: &str = include_str!("../../config/windhover.toml");

/// Predict the accuracy of geo-positioning: draw errors of GPS, compass, pixel and camera, compute the position for
/// each draw, and compare with the closed form.
///
/// Pose, pixel and error sigmas are in the section `[montecarlo]` of the configuration; the default is the paper's: the
/// camera level, 10 m above ground, GPS 3 m (95 %), tilt 0.2 degrees.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  windhover montecarlo                                          # the paper's camera and condition
  windhover montecarlo --config windhover.toml --samples 1000000 --plot predicted.svg
  windhover montecarlo --flight flight.mcap --truth flight.truth.csv --plot compared.svg")]
pub(super) struct Args {
    /// Configuration with camera, mount and `[montecarlo]`; the paper's camera where absent
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Number of draws
    #[arg(long, value_name = "N", default_value_t = 100_000, value_parser = clap::value_parser!(u64).range(2..=100_000_000))]
    samples: u64,
    /// Seed of the draws; the same seed gives the same results
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Draw the raw geo-positions of this flight's first target over the simulation
    #[arg(long, value_name = "FLIGHT", requires = "truth")]
    flight: Option<PathBuf>,
    /// True position of the target: as for report; one row for a surveyed marker at rest
    #[arg(long, value_name = "TRUTH.csv", requires = "flight")]
    truth: Option<PathBuf>,
    /// One JSON object on standard output
    #[arg(long)]
    json: bool,
    /// Draw the scatter with its circles and ellipse
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> CliResult {
    if let Some(plot) = &args.plot {
        let read = [&args.config, &args.flight, &args.truth];
        let inputs = Inputs::of(read.into_iter().filter_map(|path| path.as_deref()));
        place::check(plot, &inputs, &place::DRAWING)?;
    }
    let flight = args.flight.as_deref().map(Flight::read).transpose()?;
    let flown_with = flight.as_ref().and_then(|f| f.config.clone());
    let config = match (&args.config, flown_with) {
        (Some(path), _) => config_file::load(path).map_err(CliError::config)?,
        (None, Some(config)) => config,
        (None, None) => Config::parse(SHIPPED).map_err(CliError::config)?,
    };
    let overlay = overlay(args, flight.as_ref(), &config)?;
    let setup = Setup::new(&config.montecarlo, &config.camera);
    let analysis = setup
        .run(args.samples as usize, args.seed)
        .map_err(|e| CliError::config(format!("[montecarlo] pose and pixel: {e}")))?;
    if let Some(path) = &args.plot {
        write_plot(path, &setup, &analysis, overlay.as_ref())?;
    }
    if args.json {
        outln!("{}", as_json(&setup, &analysis, args.seed, overlay.as_ref()))?;
    } else {
        print_text(&setup, &analysis, args.seed)?;
        if let Some(flown) = &overlay {
            let (r50, r95, max) = radii(&flown.errors_m);
            outln!(
                "\nflown: {} errors, 50 % within {r50:.3} m, 95 % within {r95:.3} m, worst {max:.3} m",
                flown.errors_m.len()
            )?;
        }
    }
    Ok(())
}

/// The flight's raw geo-positions against the given truth.
fn overlay(args: &Args, flight: Option<&Flight>, config: &Config) -> Result<Option<Overlay>, CliError> {
    let (Some(flight), Some(path)) = (flight, &args.truth) else { return Ok(None) };
    let truth = Truth::read(path)?;
    let errors_m = geopositions::errors(
        flight,
        (&config.rig(), config.ground.elevation_msl_m.unwrap_or(0.0)),
        declination::of_flight(&config.compass, flight)?,
        &truth,
    );
    if errors_m.is_empty() {
        return Err(CliError::failed(format!(
            "{} has no marker of the first target together with a fix, a compass sample and a row of truth (a capture must be replayed first)",
            flight.name
        )));
    }
    Ok(Some(Overlay { name: flight.name.clone(), errors_m }))
}

fn write_plot(path: &Path, setup: &Setup, analysis: &Analysis, overlay: Option<&Overlay>) -> CliResult {
    let p = setup.position_ned_m;
    let title =
        format!("Geo-positioning error, {} errors, {:.1} m above ground", setup.distribution.name(), -p.z);
    let svg = plot::standalone(&scatter_svg(analysis, &title, overlay));
    place::write(path, &svg)
}

fn as_json(setup: &Setup, analysis: &Analysis, seed: u64, overlay: Option<&Overlay>) -> serde_json::Value {
    let (sample, closed) = (&analysis.sample_m2, &analysis.closed_m2);
    let budget: Vec<_> = analysis
        .budget
        .iter()
        .map(|line| {
            json!({
                "source": line.source, "sigma": line.sigma, "sigma_n_m": line.north_m,
                "sigma_e_m": line.east_m, "share": line.share,
            })
        })
        .collect();
    let flight = overlay.map(|flown| {
        let (r50, r95, max) = radii(&flown.errors_m);
        json!({"errors": flown.errors_m.len(), "r50_m": r50, "r95_m": r95, "max_m": max})
    });
    json!({
        "sigma_n_m": sample[(0, 0)].sqrt(),
        "sigma_e_m": sample[(1, 1)].sqrt(),
        "cov_ne_m2": sample[(0, 1)],
        "mean_n_m": analysis.mean_m.x,
        "mean_e_m": analysis.mean_m.y,
        "r50_m": analysis.r50_m,
        "r95_m": analysis.r95_m,
        "max_m": analysis.max_m,
        "distribution": setup.distribution.name(),
        "samples": analysis.errors_m.len() + analysis.missed,
        "missed": analysis.missed,
        "seed": seed,
        "closed": {
            "sigma_n_m": closed[(0, 0)].sqrt(),
            "sigma_e_m": closed[(1, 1)].sqrt(),
            "cov_ne_m2": closed[(0, 1)],
        },
        "budget": budget,
        "flight": flight,
    })
}

fn print_text(setup: &Setup, analysis: &Analysis, seed: u64) -> CliResult {
    let p = setup.position_ned_m;
    let [heading, pitch, roll] = setup.attitude_rad.map(f64::to_degrees);
    let (sample, closed) = (&analysis.sample_m2, &analysis.closed_m2);
    outln!(
        "camera at north {:.2} east {:.2} down {:.2} m, heading {heading:.1}°, pitch {pitch:.1}°, roll {roll:.1}°, pixel ({:.1}, {:.1})",
        p.x,
        p.y,
        p.z,
        setup.pixel.x,
        setup.pixel.y
    )?;
    let drawn = analysis.errors_m.len() + analysis.missed;
    outln!("{drawn} draws, {} errors, seed {seed}", setup.distribution.name())?;
    if analysis.missed > 0 {
        outln!("{} draws did not meet the ground and are left out", analysis.missed)?;
    }
    outln!("\n               north m    east m")?;
    outln!("sigma drawn   {:8.4}  {:8.4}", sample[(0, 0)].sqrt(), sample[(1, 1)].sqrt())?;
    outln!("sigma closed  {:8.4}  {:8.4}   (first order)", closed[(0, 0)].sqrt(), closed[(1, 1)].sqrt())?;
    outln!("mean          {:8.4}  {:8.4}", analysis.mean_m.x, analysis.mean_m.y)?;
    outln!(
        "\n50 % within {:.3} m, 95 % within {:.3} m, worst {:.3} m",
        analysis.r50_m,
        analysis.r95_m,
        analysis.max_m
    )?;
    outln!("\nerror budget       one sigma   north m    east m   share of variance")?;
    for line in &analysis.budget {
        let (sigma, unit) = match line.source {
            s if s.starts_with("gps") || s.starts_with("ground") => (line.sigma, "m"),
            s if ["heading", "pitch", "roll"].contains(&s) || s.starts_with("mount") => {
                (line.sigma.to_degrees(), "°")
            }
            _ => (line.sigma, "px"),
        };
        outln!(
            "{:<18} {sigma:8.3} {unit:<2} {:8.4}  {:8.4}   {:6.2} %",
            line.source,
            line.north_m,
            line.east_m,
            100.0 * line.share
        )?;
    }
    Ok(())
}
