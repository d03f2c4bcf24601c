//! Vehicles and helicopters as Cursor on Target, for TAK: where reports go, and the task that makes them.

mod event;
mod send;

use std::collections::BTreeMap;
use std::fmt;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rustls::RootCertStore;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio::sync::broadcast;
use tokio::time::Instant;
use tokio_rustls::TlsConnector;

use self::event::{of_helicopter, of_vehicle};
use self::send::send;
use super::lock;
use super::view::View;
use crate::io::clock::HostClock;
use crate::io::proto::host_time;
use windhover_base::time::UtcTime;

/// Period of the position reports, as TAK's maps expect.
const EVERY: Duration = Duration::from_secs(1);
/// Events that a server may be behind before it misses some.
const QUEUE: usize = 256;
/// Where reports go.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum CotTo {
    /// One datagram for each event, to an address or a multicast group.
    Udp(SocketAddr),
    /// A TCP server.
    Tcp(String),
    /// A TLS server.
    Tls(String),
}

impl FromStr for CotTo {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let advice = "give udp://ADDRESS:PORT, tcp://HOST:PORT or tls://HOST:PORT";
        let (kind, place) = text.split_once("://").ok_or(advice)?;
        let has_port = place
            .rsplit_once(':')
            .is_some_and(|(host, port)| !host.is_empty() && port.parse::<u16>().is_ok_and(|port| port > 0));
        match kind {
            "udp" => place
                .parse()
                .map(Self::Udp)
                .map_err(|_| format!("{place:?} is not an address with a port; {advice}")),
            "tcp" if has_port => Ok(Self::Tcp(place.into())),
            "tls" | "ssl" if has_port => Ok(Self::Tls(place.into())),
            _ => Err(advice.into()),
        }
    }
}

impl fmt::Display for CotTo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Udp(address) => write!(f, "udp://{address}"),
            Self::Tcp(place) => write!(f, "tcp://{place}"),
            Self::Tls(place) => write!(f, "tls://{place}"),
        }
    }
}

/// The files of TLS.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct CotKeys {
    /// Certificate of the authority that signed the server's certificate.
    pub authority: Option<PathBuf>,
    /// The client's certificate and its key, where the server requires one.
    pub own: Option<(PathBuf, PathBuf)>,
}

/// Makes a report of every known and new state, and sends it to every destination.
pub(super) async fn serve(
    to: Vec<CotTo>,
    tls: Option<TlsConnector>,
    view: Arc<Mutex<View>>,
) -> std::io::Result<()> {
    let events = broadcast::Sender::<Arc<str>>::new(QUEUE);
    let mut senders = tokio::task::JoinSet::new();
    for to in to {
        senders.spawn(send(to, tls.clone(), events.clone()));
    }
    let mut reported = BTreeMap::new();
    let mut tick = tokio::time::interval(EVERY);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    loop {
        tick.tick().await;
        for event in reports(&view, &mut reported) {
            // There may be no receiver.
            let _ = events.send(event.into());
        }
    }
}

/// The reports of all states that are newer than the last reports.
fn reports(view: &Mutex<View>, reported: &mut BTreeMap<String, i64>) -> Vec<String> {
    let now = Instant::now();
    // UTC by this computer's clock, which may have been set since the program started.
    let utc = UtcTime::from_unix_ns(HostClock::start().now().ns());
    let (vehicles, helicopters) = {
        let view = lock(view);
        (view.vehicles(now), view.helicopters(now))
    };
    let mut is_new = |name: String, t: i64| reported.insert(name, t) != Some(t);
    let mut all = Vec::new();
    for vehicle in &vehicles {
        let t = host_time(vehicle.state.timestamp.as_ref()).ns();
        if is_new(format!("{}/{}", vehicle.payload, vehicle.target), t) {
            all.extend(of_vehicle(vehicle, utc));
        }
    }
    for helicopter in &helicopters {
        let t = host_time(helicopter.state.timestamp.as_ref()).ns();
        if is_new(helicopter.payload.clone(), t) {
            all.push(of_helicopter(helicopter, utc));
        }
    }
    all
}

/// The TLS configuration.
///
/// # Errors
/// A file that cannot be read or has the wrong content; the message names it.
pub(super) fn connector(keys: &CotKeys) -> Result<TlsConnector, String> {
    let words = |path: &PathBuf, error: &dyn fmt::Display| format!("{}: {error}", path.display());
    let authority = keys
        .authority
        .as_ref()
        .ok_or("tls:// needs --cot-authority: the certificate that signed the server's certificate")?;
    let mut roots = RootCertStore::empty();
    let certificate = CertificateDer::from_pem_file(authority).map_err(|e| words(authority, &e))?;
    roots.add(certificate).map_err(|e| words(authority, &e))?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|e| e.to_string())?
        .with_root_certificates(roots);
    let config = match &keys.own {
        None => config.with_no_client_auth(),
        Some((certificate, key)) => {
            let chain = CertificateDer::pem_file_iter(certificate).map_err(|e| words(certificate, &e))?;
            let chain = chain.collect::<Result<Vec<_>, _>>().map_err(|e| words(certificate, &e))?;
            let private = PrivateKeyDer::from_pem_file(key).map_err(|e| words(key, &e))?;
            config.with_client_auth_cert(chain, private).map_err(|e| words(certificate, &e))?
        }
    };
    Ok(TlsConnector::from(Arc::new(config)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_destination_has_a_kind_and_a_port() {
        for fits in ["udp://239.2.3.1:6969", "tcp://tak.local:8087", "tls://[fe80::1]:8089"] {
            assert_eq!(fits.parse::<CotTo>().map(|to| to.to_string()), Ok(fits.to_owned()));
        }
        for wrong in
            ["239.2.3.1:6969", "udp://host:6969", "tcp://host", "tcp://:1", "tls://h:0", "http://h:1"]
        {
            assert!(wrong.parse::<CotTo>().is_err(), "{wrong}");
        }
    }
}
