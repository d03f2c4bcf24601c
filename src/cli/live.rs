//! `windhover simulate --live`

use std::path::Path;
use std::process::{Child, Command};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::process::{Pid, Signal, kill_process};
use tokio::signal::unix::{SignalKind, signal};

use super::{CliError, CliResult, place};
use crate::app::live::{LiveFlight, LiveFolder, LoopSettings};
use crate::cli::out::note;
use crate::config::Config;
use crate::io::link::keys::{Authority, Role};
use crate::io::new_file::Inputs;
use windhover_base::time::{NS_PER_S, UtcTime};
use windhover_simulate::Scenario;

/// Validity of a simulation's certificates, days.
const DAYS: i64 = 30;
/// Where the payload's link listens.
const LINK_AT: &str = "127.0.0.1:7447";

/// The options of a live simulation.
pub(super) struct Live<'a> {
    /// The folder of its lines, its card and its keys.
    pub(super) folder: &'a Path,
    /// Draws every random error.
    pub(super) seed: u64,
    /// Address for another program that flies the helicopter by datagrams.
    pub(super) driver: Option<&'a str>,
    /// Whether the daemon is started separately.
    pub(super) no_daemon: bool,
}

/// The first line of the configuration that is written.
const MADE_BY: &str = "# Made by windhover simulate --live.";

/// Flies a scenario in real time.
pub(super) fn run(scenario: Scenario, live: &Live<'_>) -> CliResult {
    std::fs::create_dir_all(live.folder).map_err(|e| cannot("make", live.folder, &e))?;
    let folder = std::fs::canonicalize(live.folder).map_err(|e| cannot("find", live.folder, &e))?;
    let folder = LiveFolder(folder);
    let mut config = folder.config_of(&scenario);
    with_link(&mut config, &folder.0.join("keys"))?;
    let file = folder.config_file();
    let text = format!("{MADE_BY}\n{}", config.to_toml().map_err(CliError::config)?);
    place::check(&file, &Inputs::default(), &[MADE_BY])?;
    place::write(&file, &text)?;
    let card = folder.0.join("card");
    std::fs::create_dir_all(&card).map_err(|e| cannot("make", &card, &e))?;
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let settings = LoopSettings { threads, ..LoopSettings::default() };
    let flight =
        LiveFlight::open(&folder, scenario, live.seed, &settings, live.driver).map_err(CliError::failed)?;
    let keys = folder.0.join("keys");
    note!(
        "lines, camera and configuration in {}\nthe page: windhover ground --open --connect {LINK_AT} --authority {keys}/authority.pem --certificate {keys}/station-demo.pem",
        folder.0.display(),
        keys = keys.display()
    );
    let ended = ended_by_signal()?;
    let daemon = if live.no_daemon {
        note!("start the daemon: windhover run --config {}", file.display());
        None
    } else {
        Some(start(&file)?)
    };
    let score = flight.run(&ended, |words| note!("{words}"));
    daemon.map_or(Ok(()), stop)?;
    let score = score.map_err(CliError::failed)?;
    note!(
        "follow error {:.2} m rms, {:.2} m most; tilt {:.1} deg rms, {:.1} deg most; messages {:.0} ms late, their velocity wrong by {:.3} m/s rms ({} messages)",
        score.follow_rms_m,
        score.follow_max_m,
        score.tilt_rms_deg,
        score.tilt_max_deg,
        score.lag_ms,
        score.velocity_rms_mps,
        score.messages
    );
    Ok(())
}

/// Keys for a link between this daemon and a station on this computer, made once.
fn with_link(config: &mut Config, keys: &Path) -> CliResult {
    let seconds = rustls::pki_types::UnixTime::now().as_secs();
    let now = UtcTime::from_unix_ns(i64::try_from(seconds).unwrap_or(0).saturating_mul(NS_PER_S));
    let authority = Authority::at(keys);
    if !authority.certificate_file().exists() {
        authority.create("demo", DAYS, now)?;
        authority.issue(Role::Payload, "demo", DAYS, now)?;
        authority.issue(Role::Station, "demo", DAYS, now)?;
    }
    let path = |name: &str| keys.join(name).display().to_string();
    config.link.enabled = true;
    config.link.listen = Some(LINK_AT.into());
    config.link.authority = path("authority.pem");
    config.link.certificate = path("payload-demo.pem");
    config.link.key = path("payload-demo.key");
    Ok(())
}

/// A flag that SIGINT and SIGTERM set: the flight ends then, and its daemon with it.
fn ended_by_signal() -> Result<Arc<AtomicBool>, CliError> {
    let ended = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&ended);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let signals = runtime.block_on(async {
        Ok::<_, std::io::Error>((signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?))
    });
    let (mut interrupted, mut terminated) = signals?;
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        runtime.block_on(async {
            tokio::select! {
                _ = interrupted.recv() => {}
                _ = terminated.recv() => {}
            }
        });
        flag.store(true, Ordering::Relaxed);
    })?;
    Ok(ended)
}

fn start(config: &Path) -> Result<Child, CliError> {
    let program =
        std::env::current_exe().map_err(|e| CliError::failed(format!("cannot find this program: {e}")))?;
    let mut command = Command::new(program);
    command.arg("run").arg("--config").arg(config);
    command.spawn().map_err(|e| CliError::failed(format!("cannot start the daemon: {e}")))
}

/// Asks the daemon to stop, and waits for it.
fn stop(mut daemon: Child) -> CliResult {
    if let Some(pid) = i32::try_from(daemon.id()).ok().and_then(Pid::from_raw) {
        let _ = kill_process(pid, Signal::TERM);
    }
    daemon.wait().map(drop).map_err(|e| CliError::failed(format!("the daemon: {e}")))
}

fn cannot(what: &str, path: &Path, error: &std::io::Error) -> CliError {
    CliError::failed(format!("cannot {what} {}: {error}", path.display()))
}
