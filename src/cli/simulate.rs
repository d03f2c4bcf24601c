//! `windhover simulate OUT.mcap`

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::live::{self, Live};
use super::{CliError, CliResult, place};
use crate::cli::out::{note, out, outln};
use crate::config::Config;
use crate::io::capture::CaptureWriter;
use crate::io::mcap_write::Maker;
use crate::io::new_file::{Inputs, NewFile};
use crate::jpeg;
use windhover_base::msg::{EventBody, GrayImage};
use windhover_simulate::{Deviation, Flight, FrameStorage, FrameTruth, Scenario, World, truth};

/// Make a capture of a simulated flight, with the truth beside it.
///
/// OUT.mcap has the data that real devices would deliver: bytes of the serial lines by reads, camera frames, and the
/// configuration. Beside it, OUT.truth.csv has the true state of the vehicle at each frame (OUT.truth_NAME.csv for each
/// further vehicle) and OUT.truth_ownship.csv that of the helicopter. The same scenario and seed always give the same
/// flight.
///
/// With --with the flight deviates from the configuration in OUT.mcap: for example tags of another size, walking
/// people, jittering stamps. Each such deviation is also a scenario under its own name.
#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  windhover simulate flight.mcap                          a minute of following a vehicle at 15 m
  windhover simulate a.mcap --scenario hover10 --seed 7   with other random errors
  windhover simulate b.mcap --duration 10 --scale 0.5     short, at half the resolution: a small file
  windhover simulate --live --duration 120                the helicopter follows, in real time; then windhover ground
  windhover simulate --list                               lists scenarios and deviations
  windhover simulate c.mcap --with people=3 --with readout=15   a flight that its configuration does not fit

Then:
  windhover replay flight.mcap --out result.mcap          run the pipeline over it
  windhover report result.mcap --truth flight.truth.csv   compare the estimates with the truth")]
pub(super) struct Args {
    /// Capture to write
    #[arg(required_unless_present_any = ["list", "live"], value_name = "OUT.mcap")]
    out: Option<PathBuf>,
    /// Scenario of the flight (see --list)
    #[arg(long, default_value = "follow", value_name = "NAME")]
    scenario: String,
    /// Length of the flight, seconds [default: the scenario's own, 60]
    #[arg(long, value_name = "S")]
    duration: Option<f64>,
    /// Seed of all random errors: latencies, biases, noise, wind, routes
    #[arg(long, default_value_t = 1, value_name = "N")]
    seed: u64,
    /// Camera resolution as a share of 1280 x 1024
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR")]
    scale: f64,
    /// Frames a second [default: the scenario's own, 15]
    #[arg(long, value_name = "FPS")]
    fps: Option<f64>,
    /// Let the flight deviate from its configuration (see --list); may be repeated
    #[arg(long, value_name = "NAME[=FIGURE]")]
    with: Vec<String>,
    /// JPEG quality of the frames, 1 to 100
    #[arg(long, default_value_t = 90, value_name = "Q", value_parser = clap::value_parser!(u8).range(1..=100))]
    quality: u8,
    /// Store frames as raw grey pixels instead of JPEG (large)
    #[arg(long, conflicts_with = "quality")]
    lossless: bool,
    /// Fly in real time with a daemon on pseudo-terminals: the helicopter follows the vehicle by the daemon's MAVLink
    /// messages
    #[arg(long, conflicts_with_all = ["out", "lossless"])]
    live: bool,
    /// With --live: folder for lines, configuration, keys and card
    #[arg(long, value_name = "DIR", default_value = "windhover-live", requires = "live")]
    dir: PathBuf,
    /// With --live: another program flies the helicopter, by UDP datagrams at this address (docs/autopilot.md)
    #[arg(long, value_name = "ADDRESS:PORT", requires = "live")]
    driver: Option<String>,
    /// With --live: the daemon is started by hand
    #[arg(long, requires = "live")]
    no_daemon: bool,
    /// List scenarios and deviations and exit
    #[arg(long)]
    list: bool,
}

pub(super) fn run(args: &Args) -> CliResult {
    if args.list {
        return list();
    }
    if args.live {
        let live = Live {
            folder: &args.dir,
            seed: args.seed,
            driver: args.driver.as_deref(),
            no_daemon: args.no_daemon,
        };
        return live::run(scenario(args)?, &live);
    }
    let out = args.out.as_deref().ok_or_else(|| CliError::usage("give the capture to write"))?;
    let scenario = scenario(args)?;
    check_places(out, &scenario)?;
    let quality = args.quality;
    let encode = move |image: &GrayImage| jpeg::encode_grey(image, quality).map_err(|e| e.to_string());
    let storage = if args.lossless { FrameStorage::Raw } else { FrameStorage::Jpeg(Arc::new(encode)) };
    write_flight(scenario, args.seed, storage, out)
}

/// One line for each, which begins with a name for `--scenario`.
fn list() -> CliResult {
    for (name, about) in Scenario::names().iter().copied().chain(Scenario::composed()) {
        outln!("{name:18} {about}")?;
    }
    for d in Deviation::all() {
        let (name, effect, (low, high)) = (d.name, d.effect.name(), d.limits);
        out!("{name:18} {effect}: {}", d.about)?;
        match low < high {
            true => outln!("; --with {name}[={}] {}, {low} to {high}", d.usual, d.unit)?,
            false => outln!("; --with {name}")?,
        }
    }
    Ok(())
}

fn scenario(args: &Args) -> Result<Scenario, CliError> {
    let unknown = || {
        CliError::usage(format!(
            "unknown scenario {:?}; `windhover simulate --list` lists them",
            args.scenario
        ))
    };
    let mut scenario = Scenario::named(&args.scenario).ok_or_else(unknown)?;
    if !(0.05..=4.0).contains(&args.scale) {
        return Err(CliError::usage(format!("--scale {}: give a factor between 0.05 and 4", args.scale)));
    }
    if args.scale != 1.0 {
        scenario = scenario.with_resolution(args.scale);
    }
    if let Some(duration_s) = args.duration {
        if !(0.1..=36_000.0).contains(&duration_s) {
            return Err(CliError::usage(format!("--duration {duration_s}: give 0.1 to 36000 seconds")));
        }
        scenario.duration_s = duration_s;
    }
    if let Some(fps) = args.fps {
        scenario.rig.camera.fps = fps;
    }
    for text in &args.with {
        let refused =
            |e| CliError::usage(format!("--with {text}: {e}; `windhover simulate --list` lists them"));
        scenario.deviate_as(text).map_err(refused)?;
    }
    config_of(&scenario)
        .check()
        .map_err(|e| CliError::usage(format!("there is no valid configuration for this flight: {e}")))?;
    Ok(scenario)
}

/// The daemon's configuration for the scenario.
fn config_of(scenario: &Scenario) -> Config {
    Config::of_rig(scenario.rig.clone(), scenario.ground())
}

/// `flight.mcap` → `flight.SUFFIX.csv`.
fn beside(out: &Path, suffix: &str) -> PathBuf {
    out.with_extension(format!("{suffix}.csv"))
}

/// The truths of a flight's vehicles, in their order, then the helicopter's.
fn truth_paths(out: &Path, scenario: &Scenario) -> Vec<PathBuf> {
    let targets = scenario.rig.target.iter().enumerate();
    let vehicles = targets.map(|(i, target)| match i {
        0 => beside(out, "truth"),
        _ => beside(out, &format!("truth_{}", target.name)),
    });
    vehicles.chain([beside(out, "truth_ownship")]).collect()
}

/// A flight and its truth overwrite older ones of a simulation, and no other files.
fn check_places(out: &Path, scenario: &Scenario) -> CliResult {
    place::check(out, &Inputs::default(), &Maker::Capture.marks())?;
    let truths = truth_paths(out, scenario);
    let marks = [truth::VEHICLE_COLUMNS];
    let (own, vehicles) = truths.split_last().expect("the helicopter's is the last");
    vehicles.iter().try_for_each(|path| place::check(path, &Inputs::default(), &marks))?;
    place::check(own, &Inputs::default(), &[truth::OWNSHIP_HEADER])
}

struct TruthFiles {
    files: Vec<(PathBuf, BufWriter<NewFile>)>,
}

impl TruthFiles {
    /// One file for each vehicle, then the helicopter's.
    fn create(out: &Path, world: &World) -> Result<Self, CliError> {
        let paths = truth_paths(out, world.scenario());
        let vehicles = (0..world.scenario().rig.target.len()).map(|i| truth::vehicle_header(world, i));
        let headed = paths.into_iter().zip(vehicles.chain([truth::OWNSHIP_HEADER.to_owned()]));
        let mut files = Vec::new();
        for (path, header) in headed {
            let file = NewFile::create(&path).map_err(|e| cannot_write(&path, &e))?;
            files.push((path, BufWriter::new(file)));
            Self::line(files.last_mut().expect("one was just pushed"), &header)?;
        }
        Ok(Self { files })
    }

    fn line((path, file): &mut (PathBuf, BufWriter<NewFile>), text: &str) -> Result<(), CliError> {
        writeln!(file, "{text}").map_err(|e| cannot_write(path, &e))
    }

    fn frame(&mut self, world: &World, frame: &FrameTruth) -> Result<(), CliError> {
        let vehicles = world.vehicles();
        for (target, file) in self.files.iter_mut().enumerate().take(vehicles) {
            Self::line(file, &truth::vehicle_row(world, target, frame))?;
        }
        Self::line(&mut self.files[vehicles], &truth::ownship_row(world, frame))
    }

    fn finish(self) -> Result<Vec<PathBuf>, CliError> {
        let close = |(path, file): (PathBuf, BufWriter<NewFile>)| {
            let whole = file.into_inner().map_err(|e| e.into_error()).and_then(NewFile::finish);
            whole.map_err(|e| cannot_write(&path, &e)).map(|()| path)
        };
        self.files.into_iter().map(close).collect()
    }
}

fn cannot_write(path: &Path, error: &std::io::Error) -> CliError {
    CliError::failed(format!("cannot write {}: {error}", path.display()))
}

fn write_flight(scenario: Scenario, seed: u64, storage: FrameStorage, out: &Path) -> CliResult {
    let name = scenario.name.clone();
    let frames = (scenario.duration_s * scenario.rig.camera.fps).round() as u64;
    let world = Arc::new(World::new(scenario, seed));
    let config = config_of(world.scenario()).to_toml().map_err(CliError::config)?;
    let mut writer = CaptureWriter::create(out, &config, world.scenario().start).map_err(CliError::failed)?;
    let mut truths = TruthFiles::create(out, &world)?;
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let mut flight = Flight::new(Arc::clone(&world), storage, threads);
    // Shown on a terminal only: indicatif hides it elsewhere.
    let bar = indicatif::ProgressBar::new(frames);
    bar.set_style(
        indicatif::ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} frames, {eta} to go")
            .expect("the template is valid"),
    );
    bar.set_message(name.clone());
    while let Some(event) = flight.next() {
        let event = event?;
        writer.write(&event).map_err(CliError::failed)?;
        if let (EventBody::Frame(_), Some(frame)) = (&event.body, flight.frame_truth()) {
            truths.frame(&world, frame)?;
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    writer.finish().map_err(CliError::failed)?;
    let beside: Vec<_> = truths.finish()?.iter().map(|p| p.display().to_string()).collect();
    let written = bar.position();
    note!("{}: {name}, seed {seed}, {written} frames; truth in {}", out.display(), beside.join(", "));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_named_scenario_can_be_flown() {
        let deviations = Deviation::all().iter().map(|d| d.name);
        let scenarios = Scenario::names().iter().copied().chain(Scenario::composed()).map(|(name, _)| name);
        for name in scenarios.chain(deviations) {
            let scenario = Scenario::named(name).expect("it is listed");
            config_of(&scenario).check().unwrap_or_else(|e| panic!("{name}: {e}"));
        }
    }
}
