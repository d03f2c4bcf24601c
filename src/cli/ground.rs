//! `windhover ground`: the receiving station.

use std::io::IsTerminal as _;
use std::net::SocketAddr;
use std::path::PathBuf;

use super::{CliError, CliResult};
use crate::app::ground::{self, CotKeys, CotTo, GroundSettings};
use crate::app::log;
use crate::io::clock::HostClock;
use crate::io::link::StationSettings;
use crate::io::link::tls::KeyFiles;
use crate::text::number;

/// Receive from payloads: store their flights, show them on a web page, feed other programs.
#[derive(clap::Args, Debug)]
#[command(after_help = "Example:
  windhover keys authority && windhover keys payload bird && windhover keys station hut
  windhover ground --certificate keys/station-hut.pem --connect 10.0.0.2:4433")]
pub(super) struct Args {
    /// Payload to connect to; may be given several times
    #[arg(long, value_name = "HOST:PORT", value_parser = host_and_port)]
    connect: Vec<String>,
    /// Address at which payloads connect to this station
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: Option<SocketAddr>,
    /// Certificate of the authority
    #[arg(long, value_name = "FILE", default_value = "keys/authority.pem")]
    authority: PathBuf,
    /// Certificate of this station, from `windhover keys station`
    #[arg(long, value_name = "FILE")]
    certificate: PathBuf,
    /// Private key of this station [default: the file beside the certificate]
    #[arg(long, value_name = "FILE")]
    key: Option<PathBuf>,
    /// Revocation list [default: the file beside the authority's certificate, if there is one]
    #[arg(long, value_name = "FILE")]
    revoked: Option<PathBuf>,
    /// Directory for the received flights
    #[arg(long, value_name = "DIR", default_value = "ground")]
    out: PathBuf,
    /// Address of the web page; other addresses than loopback require a token
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8080")]
    web: SocketAddr,
    /// Open the page in this desktop's browser
    #[arg(long, conflicts_with = "no_web")]
    open: bool,
    /// Serve no web page
    #[arg(long)]
    no_web: bool,
    /// Token that visitors of the page must send; random and printed when the page is not on loopback
    #[arg(long)]
    token: Option<String>,
    /// Folder with map tiles (Z/X/Y.png, Web Mercator)
    #[arg(long, value_name = "DIR")]
    tiles: Option<PathBuf>,
    /// Position of the station, degrees: the page shows distance and bearing from there [default: the first position of
    /// the helicopter]
    #[arg(long, value_name = "LAT,LON", value_parser = position, allow_hyphen_values = true)]
    position: Option<[f64; 2]>,
    /// Serve the vehicles as NMEA (RMC, GGA, GSA, GST) over TCP here, for example 127.0.0.1:10110
    #[arg(long, value_name = "ADDRESS:PORT")]
    nmea: Option<SocketAddr>,
    /// Send vehicles and helicopters as Cursor on Target, for TAK: udp://ADDRESS:PORT (TAK's group is 239.2.3.1:6969),
    /// tcp://HOST:PORT or tls://HOST:PORT; may be given several times
    #[arg(long, value_name = "URL")]
    cot: Vec<CotTo>,
    /// Certificate of the authority that signed the TAK server's certificate
    #[arg(long, value_name = "FILE")]
    cot_authority: Option<PathBuf>,
    /// Client certificate for the TAK server
    #[arg(long, value_name = "FILE", requires = "cot_key")]
    cot_certificate: Option<PathBuf>,
    /// Private key of that certificate
    #[arg(long, value_name = "FILE", requires = "cot_certificate")]
    cot_key: Option<PathBuf>,
    /// Serve Foxglove over its WebSocket; other addresses than loopback require the token
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, default_missing_value = "127.0.0.1:8765")]
    foxglove: Option<SocketAddr>,
    /// Publish on Zenoh and answer queries there: without a value on loopback only (as a router, or at the one that is
    /// there), else a router's endpoint (tcp/HOST:PORT) or a file with Zenoh's configuration; needs a build with the
    /// feature `zenoh`
    #[arg(long, value_name = "ENDPOINT|FILE", num_args = 0..=1, default_missing_value = "tcp/127.0.0.1:7447")]
    zenoh: Option<String>,
    /// Publish the payloads as nodes of ROS 2 over Zenoh, as `rmw_zenoh_cpp` does, in this domain (`ROS_DOMAIN_ID`)
    #[arg(long, value_name = "DOMAIN", num_args = 0..=1, default_missing_value = "0", requires = "zenoh",
        value_parser = clap::value_parser!(u8).range(0..=232))]
    ros: Option<u8>,
    /// Request no thumbnails of the camera image
    #[arg(long)]
    no_thumbnails: bool,
}

/// An address to connect to: a name, an IPv4 address or an IPv6 address in brackets, with a port.
fn host_and_port(text: &str) -> Result<String, String> {
    let advice = "give HOST:PORT; the port is that of `listen` in the payload's [link]";
    let (host, port) = text.rsplit_once(':').ok_or(advice)?;
    let bracketed = host.starts_with('[') && host.ends_with(']');
    let port_fits = port.parse::<u16>().is_ok_and(|port| port > 0);
    if host.is_empty() || !port_fits || (host.contains(':') && !bracketed) {
        return Err(advice.into());
    }
    Ok(text.to_owned())
}

/// A place on the Earth, in degrees.
fn position(text: &str) -> Result<[f64; 2], String> {
    let (lat, lon) =
        text.split_once(',').ok_or("give latitude and longitude in degrees, such as 48.1,11.6")?;
    let [lat, lon] = [number(lat)?, number(lon)?];
    let fits = lat.abs() <= 90.0 && lon.abs() <= 180.0;
    fits.then_some([lat, lon]).ok_or_else(|| format!("{lat}, {lon} is not a place on the Earth"))
}

pub(super) fn run(args: &Args) -> CliResult {
    if args.connect.is_empty() && args.listen.is_none() {
        return Err(CliError::usage(
            "give the payload to connect to (--connect) or the address for payloads (--listen)",
        ));
    }
    let token_fits =
        |t: &String| t.len() >= 8 && t.chars().all(|c| c.is_ascii_alphanumeric() || "-_.~".contains(c));
    if args.token.as_ref().is_some_and(|token| !token_fits(token)) {
        return Err(CliError::usage(
            "--token must have at least 8 characters, only letters, digits and -_.~",
        ));
    }
    if (args.zenoh.is_some() || args.ros.is_some()) && !cfg!(feature = "zenoh") {
        return Err(CliError::usage(
            "this windhover was built without Zenoh: build it with `cargo build --release --features zenoh`",
        ));
    }
    let revoked = args.revoked.clone().or_else(|| {
        let beside = args.authority.with_file_name("revoked.pem");
        beside.exists().then_some(beside)
    });
    let settings = GroundSettings {
        link: StationSettings {
            files: KeyFiles {
                authority: args.authority.clone(),
                certificate: args.certificate.clone(),
                key: args.key.clone().unwrap_or_else(|| args.certificate.with_extension("key")),
                revoked,
            },
            listen: args.listen,
            dial: args.connect.clone(),
            thumbnails: !args.no_thumbnails,
        },
        out: args.out.clone(),
        web: (!args.no_web).then_some(args.web),
        open: args.open,
        token: args.token.clone(),
        tiles: args.tiles.clone(),
        position: args.position,
        nmea: args.nmea,
        foxglove: args.foxglove,
        cot: args.cot.clone(),
        cot_keys: CotKeys {
            authority: args.cot_authority.clone(),
            own: args.cot_certificate.clone().zip(args.cot_key.clone()),
        },
        #[cfg(feature = "zenoh")]
        zenoh: args.zenoh.clone(),
        #[cfg(feature = "zenoh")]
        ros: args.ros,
        terminal: std::io::stdout().is_terminal(),
    };
    let _log = log::start_plain(HostClock::start());
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        let stop = tokio::sync::watch::Sender::new(false);
        let stopped = stop.subscribe();
        tokio::spawn(async move {
            let mut terminate =
                tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate()).ok();
            let terminated = async {
                match &mut terminate {
                    Some(signal) => signal.recv().await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminated => {}
            }
            stop.send_replace(true);
        });
        ground::run(settings, stopped).await
    })?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_a_port_and_a_place_is_on_the_earth() {
        for fits in ["10.0.0.2:4433", "heli:7447", "[fe80::1%wlan0]:7447", "heli.local:1"] {
            assert_eq!(host_and_port(fits).as_deref(), Ok(fits));
        }
        for wrong in [
            "10.0.0.2",
            "heli",
            "heli:",
            "heli:0",
            "heli:99999",
            ":7447",
            "fe80::1",
            "fe80::1:7447x",
            "::1:7447",
        ] {
            assert!(host_and_port(wrong).is_err(), "{wrong}");
        }
        assert_eq!(position("-33.9, 151.2"), Ok([-33.9, 151.2]));
        for wrong in ["48.1", "91,0", "0,181", "nan,0", "a,b"] {
            assert!(position(wrong).is_err(), "{wrong}");
        }
    }
}
