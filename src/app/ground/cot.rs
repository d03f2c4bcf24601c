//! Vehicles and helicopters as Cursor on Target, for TAK: events as XML, and the task that sends them.
//!
//! Source: MITRE, Cursor on Target Message Router User's Guide, and its `event` schema, version 2.0.

use std::collections::BTreeMap;
use std::fmt;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rustls::RootCertStore;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::{TcpStream, UdpSocket};
use tokio::sync::broadcast;
use tokio::time::Instant;
use tokio_rustls::TlsConnector;

use super::lock;
use super::view::{Helicopter, Vehicle, View};
use crate::app::events::OperatorEvent;
use crate::io::clock::HostClock;
use crate::io::proto::host_time;
use crate::text::xml;
use windhover_base::time::{Span, UtcTime};

/// Period of the position reports, as TAK's maps expect.
const EVERY: Duration = Duration::from_secs(1);
/// A report older than this is not a current position.
const STALE: Span = Span::from_ns(5_000_000_000);
/// A server that accepts nothing for this time is connected again.
const PATIENCE: Duration = Duration::from_secs(10);
/// Pauses before a server is connected again, shortest and longest; each is twice the one before.
const PAUSES_S: (u64, u64) = (1, 30);
/// Events that a server may be behind before it misses some.
const QUEUE: usize = 256;
/// Cursor on Target's value for an unknown error.
const UNKNOWN_M: &str = "9999999.0";
/// How many networks a datagram crosses; more than the local one needs a multicast router.
const HOPS: u32 = 1;

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

/// The content of a report.
struct Report<'a> {
    uid: String,
    kind: &'static str,
    callsign: &'a str,
    place: [f64; 3],
    /// One sigma: circular, linear; `None` where not known.
    errors_m: [Option<f64>; 2],
    course_deg: f64,
    speed_mps: f64,
    remarks: &'a str,
    at: UtcTime,
}

impl Report<'_> {
    fn event(&self, now: UtcTime) -> String {
        let [ce, le] = self.errors_m.map(|error| match error {
            Some(m) if m.is_finite() => format!("{m:.2}"),
            _ => UNKNOWN_M.to_owned(),
        });
        let [lat, lon, hae] = self.place;
        let stale = UtcTime::from_unix_ns(self.at.unix_ns().saturating_add(STALE.ns()));
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?><event version=\"2.0\" uid=\"{}\" type=\"{}\" how=\"m-f\" \
             time=\"{now}\" start=\"{}\" stale=\"{stale}\"><point lat=\"{lat:.9}\" lon=\"{lon:.9}\" hae=\"{hae:.3}\" \
             ce=\"{ce}\" le=\"{le}\"/><detail><contact callsign=\"{}\"/><track course=\"{:.2}\" speed=\"{:.3}\"/>\
             <remarks>{}</remarks></detail></event>",
            xml(&self.uid),
            self.kind,
            self.at,
            xml(self.callsign),
            self.course_deg.rem_euclid(360.0),
            self.speed_mps,
            xml(self.remarks)
        )
    }
}

/// The UTC at which a state of this age was valid: by the receiver, else by this computer's clock.
fn time_of(utc: Option<UtcTime>, age: Span, now: UtcTime) -> UtcTime {
    utc.unwrap_or_else(|| UtcTime::from_unix_ns(now.unix_ns().saturating_sub(age.ns())))
}

/// The larger one-sigma of a horizontal covariance.
fn circular_m(nn: f64, ne: f64, ee: f64) -> f64 {
    let (mean, half) = ((nn + ee) / 2.0, ((nn - ee) / 2.0).hypot(ne));
    (mean + half).max(0.0).sqrt()
}

/// A vehicle's report; `None` where its state is not a current position.
pub(super) fn of_vehicle(vehicle: &Vehicle, now: UtcTime) -> Option<String> {
    let s = &vehicle.state;
    if !vehicle.is_current() {
        return None;
    }
    let ce = match s.covariance[..] {
        [nn, ne, _, _, _, ee, ..] => Some(circular_m(nn, ne, ee)),
        _ => None,
    };
    // A vehicle that reverses moves against its heading.
    let back = if s.speed_mps < 0.0 { 180.0 } else { 0.0 };
    let report = Report {
        uid: format!("windhover.{}.{}", vehicle.payload, vehicle.target),
        kind: "a-f-G-E-V",
        callsign: &vehicle.target,
        place: [s.lat_deg, s.lon_deg, s.height_m],
        errors_m: [ce, None],
        course_deg: s.heading_rad.to_degrees() + back,
        speed_mps: s.speed_mps.abs(),
        remarks: vehicle.status,
        at: time_of(vehicle.utc, vehicle.age, now),
    };
    Some(report.event(now))
}

/// A helicopter's report.
pub(super) fn of_helicopter(helicopter: &Helicopter, now: UtcTime) -> String {
    let own = &helicopter.state;
    // Upper triangle of 9×9: north 0, north-east 1, east 9, down 17.
    let (ce, le) = match (&own.covariance[..], &own.position_sigma_m[..]) {
        (p, _) if p.len() == 45 => (Some(circular_m(p[0], p[1], p[9])), Some(p[17].max(0.0).sqrt())),
        (_, [n, e, d]) => (Some(n.max(*e)), Some(*d)),
        _ => (None, None),
    };
    let report = Report {
        uid: format!("windhover.{}", helicopter.payload),
        kind: "a-f-A-M-H-Q",
        callsign: &helicopter.payload,
        place: [own.lat_deg, own.lon_deg, own.height_m],
        errors_m: [ce, le],
        course_deg: own.ve_mps.atan2(own.vn_mps).to_degrees(),
        speed_mps: own.vn_mps.hypot(own.ve_mps),
        remarks: "watching",
        at: time_of(helicopter.utc, helicopter.age, now),
    };
    report.event(now)
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

/// Sends events to one destination without end; a failure is reported once and the destination is tried again.
async fn send(to: CotTo, tls: Option<TlsConnector>, events: broadcast::Sender<Arc<str>>) {
    let mut pause_s = PAUSES_S.0;
    let mut troubled = false;
    loop {
        let began = Instant::now();
        let ended = match (&to, &tls) {
            (CotTo::Udp(address), _) => datagrams(*address, events.subscribe(), &to, &mut troubled).await,
            (CotTo::Tcp(place), _) => called(place, None, &events, &to, &mut troubled).await,
            (CotTo::Tls(place), tls) => called(place, tls.as_ref(), &events, &to, &mut troubled).await,
        };
        let Err(error) = ended else { return };
        if !std::mem::replace(&mut troubled, true) {
            OperatorEvent::LinkFault.emit("cot", format!("{to}: {error}; tried again"));
        }
        if began.elapsed() > Duration::from_secs(PAUSES_S.1) {
            pause_s = PAUSES_S.0;
        }
        tokio::time::sleep(Duration::from_secs(pause_s)).await;
        pause_s = (2 * pause_s).min(PAUSES_S.1);
    }
}

fn is_up(to: &CotTo, troubled: &mut bool) {
    if std::mem::replace(troubled, false) {
        OperatorEvent::LinkUp.emit("cot", format!("{to} accepts reports again"));
    }
}

/// Sends one datagram for each event, until the events end.
async fn datagrams(
    address: SocketAddr,
    mut events: broadcast::Receiver<Arc<str>>,
    to: &CotTo,
    troubled: &mut bool,
) -> std::io::Result<()> {
    let any: SocketAddr = if address.is_ipv4() { ([0, 0, 0, 0], 0).into() } else { ([0u16; 8], 0).into() };
    let socket = UdpSocket::bind(any).await?;
    if address.is_ipv4() {
        socket.set_multicast_ttl_v4(HOPS)?;
    }
    while let Some(event) = next(&mut events).await {
        socket.send_to(event.as_bytes(), address).await?;
        is_up(to, troubled);
    }
    Ok(())
}

/// Sends events over a connection, until the events end.
async fn called(
    place: &str,
    tls: Option<&TlsConnector>,
    events: &broadcast::Sender<Arc<str>>,
    to: &CotTo,
    troubled: &mut bool,
) -> std::io::Result<()> {
    let stream = timed(TcpStream::connect(place)).await?;
    stream.set_nodelay(true)?;
    let events = events.subscribe();
    match tls {
        None => stream_events(stream, events, to, troubled).await,
        Some(tls) => {
            let host = place.rsplit_once(':').map_or(place, |(host, _)| host).trim_matches(['[', ']']);
            let name = ServerName::try_from(host.to_owned()).map_err(std::io::Error::other)?;
            let stream = timed(tls.connect(name, stream)).await?;
            stream_events(stream, events, to, troubled).await
        }
    }
}

async fn timed<T>(what: impl Future<Output = std::io::Result<T>>) -> std::io::Result<T> {
    tokio::time::timeout(PATIENCE, what).await.unwrap_or_else(|_| Err(std::io::ErrorKind::TimedOut.into()))
}

async fn stream_events(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    mut events: broadcast::Receiver<Arc<str>>,
    to: &CotTo,
    troubled: &mut bool,
) -> std::io::Result<()> {
    let mut ignored = [0; 4096];
    loop {
        tokio::select! {
            // Reports of others are ignored.
            said = stream.read(&mut ignored) => if said? == 0 {
                return Err(std::io::ErrorKind::ConnectionReset.into());
            },
            event = next(&mut events) => match event {
                Some(event) => {
                    timed(async {
                        stream.write_all(event.as_bytes()).await?;
                        stream.write_all(b"\n").await?;
                        stream.flush().await
                    })
                    .await?;
                    is_up(to, troubled);
                }
                None => return Ok(()),
            },
        }
    }
}

/// The next event; `None` when there are no more. Missed events are skipped.
async fn next(events: &mut broadcast::Receiver<Arc<str>>) -> Option<Arc<str>> {
    loop {
        match events.recv().await {
            Ok(event) => return Some(event),
            Err(broadcast::error::RecvError::Lagged(_)) => {}
            Err(broadcast::error::RecvError::Closed) => return None,
        }
    }
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
    use crate::io::proto::windhover::{Ownship, TargetState};

    fn vehicle(status: &'static str) -> Vehicle {
        let mut covariance = vec![0.0; 15];
        (covariance[0], covariance[1], covariance[5]) = (4.0, 1.5, 4.0);
        let state = TargetState {
            lat_deg: 47.5,
            lon_deg: 8.25,
            height_m: 512.25,
            heading_rad: 0.5,
            speed_mps: -2.0,
            covariance,
            ..TargetState::default()
        };
        Vehicle {
            payload: "bird".into(),
            target: "a<b".into(),
            state,
            status,
            age: Span::from_s(0.5),
            utc: Some(UtcTime::from_unix_ns(1_795_046_445_250_000_000)),
            receiver: None,
            trail: Vec::new(),
        }
    }

    #[test]
    fn a_report_says_where_how_well_and_until_when() {
        let now = UtcTime::from_unix_ns(1_795_046_446_000_000_000);
        let event = of_vehicle(&vehicle("tracking"), now).expect("it is current");
        for part in [
            "uid=\"windhover.bird.a&lt;b\" type=\"a-f-G-E-V\"",
            "start=\"2026-11-19T00:00:45.250Z\" stale=\"2026-11-19T00:00:50.250Z\"",
            "lat=\"47.500000000\" lon=\"8.250000000\" hae=\"512.250\" ce=\"2.35\" le=\"9999999.0\"",
            "course=\"208.65\" speed=\"2.000\"",
        ] {
            assert!(event.contains(part), "{part}: {event}");
        }
        assert!(of_vehicle(&vehicle("lost"), now).is_none());
        let unset = Vehicle { utc: None, ..vehicle("tracking") };
        let event = of_vehicle(&unset, now).expect("it is current");
        assert!(event.contains("start=\"2026-11-19T00:00:45.500Z\""), "{event}");
        let state = Ownship {
            position_sigma_m: vec![1.0, 2.0, 3.0],
            vn_mps: 3.0,
            ve_mps: -4.0,
            ..Ownship::default()
        };
        let own = Helicopter { payload: "bird".into(), state, age: Span::ZERO, utc: None };
        let event = of_helicopter(&own, now);
        assert!(
            event.contains("ce=\"2.00\" le=\"3.00\"") && event.contains("course=\"306.87\" speed=\"5.000\""),
            "{event}"
        );
    }

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
