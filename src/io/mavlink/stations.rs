//! Destinations of MAVLink: addresses by name, two sockets, and the result of each datagram.

use std::io;
use std::net::{SocketAddr, ToSocketAddrs as _, UdpSocket};

use socket2::{Domain, Protocol, Socket, Type};

use crate::config::AUTOPILOT;
use crate::io::autopilot::ToAutopilot;
use windhover_base::time::{MonoTime, Span};

/// Period of name resolution for stations that do not resolve, or to which sending fails.
const RESOLVE_EVERY: Span = Span::from_ns(10_000_000_000);

/// One station, with the state of sending to it.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Station {
    /// `host:port` as configured.
    pub name: String,
    /// Its address, once resolved.
    pub address: Option<SocketAddr>,
    /// Datagrams sent.
    pub sent: u64,
    /// Datagrams that the system refused.
    pub failed: u64,
    /// Why nothing is sent there at present.
    pub fault: Option<String>,
}

impl Station {
    /// As text: how many datagrams were sent, and why no more are.
    pub fn words(&self) -> String {
        let mut words = format!("{} {} sent", self.name, self.sent);
        if self.failed > 0 {
            words += &format!(", {} failed", self.failed);
        }
        if let Some(fault) = &self.fault {
            words += &format!(" ({fault})");
        }
        words
    }
}

/// A change of a station, for the operator.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct StationChange {
    /// Which station.
    pub name: String,
    /// The fault; `None` where it is over.
    pub fault: Option<String>,
}

/// The result of resolving a name: an address, or why there is none.
pub type Found = (String, Result<SocketAddr, String>);

/// Addresses of stations by their names, IPv4 first where a name has both. Blocks until they are resolved.
pub fn look_up(names: Vec<String>) -> Vec<Found> {
    let find = |name: &str| -> io::Result<SocketAddr> {
        let all: Vec<SocketAddr> = match name.parse() {
            Ok(address) => vec![address],
            Err(_) => {
                let (host, port) = name.rsplit_once(':').unwrap_or((name, "0"));
                let host = host.trim_start_matches('[').trim_end_matches(']');
                (host, port.parse().unwrap_or(0)).to_socket_addrs()?.collect()
            }
        };
        let first = all.iter().find(|address| address.is_ipv4()).or(all.first());
        first.copied().ok_or_else(|| io::Error::other("the name has no address"))
    };
    let found = |name: String| {
        let address = find(&name).map_err(|error| format!("cannot be resolved: {error}"));
        (name, address)
    };
    names.into_iter().map(found).collect()
}

/// All stations, and the sockets to reach them.
#[derive(Debug)]
pub struct Stations {
    v4: UdpSocket,
    /// Opened for the first station with an IPv6 address; `None` before that, and on a computer without IPv6.
    v6: Option<UdpSocket>,
    to_autopilot: ToAutopilot,
    all: Vec<Station>,
    asked: Option<MonoTime>,
    news: Vec<StationChange>,
}

impl Stations {
    /// Stations of these names, none of them resolved yet. Datagrams may be broadcast.
    pub fn open(names: &[String], to_autopilot: ToAutopilot) -> io::Result<Self> {
        let v4 = UdpSocket::bind("0.0.0.0:0")?;
        v4.set_broadcast(true)?;
        v4.set_nonblocking(true)?;
        let all = names.iter().map(|name| Station { name: name.clone(), ..Station::default() }).collect();
        Ok(Self { v4, v6: None, to_autopilot, all, asked: None, news: Vec::new() })
    }

    /// The stations.
    pub fn all(&self) -> &[Station] {
        &self.all
    }

    /// Changes since the last call.
    pub fn news(&mut self) -> Vec<StationChange> {
        std::mem::take(&mut self.news)
    }

    /// Names that are to be resolved at `now`: those without an address, or where sending fails.
    pub fn unresolved(&mut self, now: MonoTime) -> Option<Vec<String>> {
        let missing = |s: &&Station| s.name != AUTOPILOT && (s.address.is_none() || s.fault.is_some());
        let wanted = self.all.iter().filter(missing);
        let names: Vec<String> = wanted.map(|station| station.name.clone()).collect();
        if names.is_empty() || self.asked.is_some_and(|last| now - last < RESOLVE_EVERY) {
            return None;
        }
        self.asked = Some(now);
        Some(names)
    }

    /// Takes the results of name resolution.
    pub fn found(&mut self, found: Vec<Found>) {
        for (name, address) in found {
            let Some(station) = self.all.iter_mut().find(|station| station.name == name) else { continue };
            match address {
                Ok(address) => {
                    station.address = Some(address);
                    if address.is_ipv6() && self.v6.is_none() {
                        self.v6 = v6_socket().ok();
                    }
                }
                Err(why) => report(station, Some(why), &mut self.news),
            }
        }
    }

    /// Sends a datagram to every station that has an address.
    pub fn send(&mut self, bytes: &[u8]) {
        for station in &mut self.all {
            if station.name == AUTOPILOT {
                self.to_autopilot.send(bytes);
                station.sent += 1;
                continue;
            }
            let Some(address) = station.address else { continue };
            let socket = if address.is_ipv4() { Some(&self.v4) } else { self.v6.as_ref() };
            let sent = match socket {
                Some(socket) => socket.send_to(bytes, address).map_err(|error| error.to_string()),
                None => Err("this computer has no IPv6".into()),
            };
            match sent {
                Ok(_) => station.sent += 1,
                Err(_) => station.failed += 1,
            }
            report(station, sent.err(), &mut self.news);
        }
    }

    /// Receives one datagram from either socket; returns its length.
    pub fn receive(&self, buffer: &mut [u8]) -> Option<usize> {
        let sockets = std::iter::once(&self.v4).chain(&self.v6);
        sockets.into_iter().find_map(|socket| socket.recv_from(buffer).ok()).map(|(length, _)| length)
    }
}

fn report(station: &mut Station, fault: Option<String>, news: &mut Vec<StationChange>) {
    // A repeated fault of the same kind is no change, and neither is success from the first datagram on.
    if station.fault != fault {
        station.fault.clone_from(&fault);
        news.push(StationChange { name: station.name.clone(), fault });
    }
}

fn v6_socket() -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV6, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_only_v6(true)?;
    socket.bind(&SocketAddr::from((std::net::Ipv6Addr::UNSPECIFIED, 0)).into())?;
    socket.set_nonblocking(true)?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn to(names: &[&str]) -> Stations {
        let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
        let mut stations = Stations::open(&names, ToAutopilot::default()).expect("sockets");
        let unresolved = stations.unresolved(MonoTime::default()).expect("all are to be resolved");
        stations.found(look_up(unresolved));
        stations
    }

    #[test]
    fn ipv4_and_ipv6_are_reached_and_broadcast_is_allowed() {
        let mut names = Vec::new();
        let listen = |address: &str| UdpSocket::bind(address).ok();
        let receivers: Vec<UdpSocket> = ["127.0.0.1:0", "[::1]:0"].into_iter().filter_map(listen).collect();
        for receiver in &receivers {
            receiver.set_read_timeout(Some(std::time::Duration::from_secs(5))).expect("a time-out");
            names.push(receiver.local_addr().expect("an address").to_string());
        }
        let mut names: Vec<&str> = names.iter().map(String::as_str).collect();
        names.push("127.255.255.255:9");
        let mut stations = to(&names);
        stations.send(b"hello");
        for receiver in &receivers {
            let mut buffer = [0; 16];
            assert_eq!(receiver.recv(&mut buffer).expect("received"), 5);
        }
        let failed: Vec<&Station> = stations.all().iter().filter(|s| s.sent != 1 || s.failed > 0).collect();
        assert!(failed.is_empty(), "{failed:?}");
        assert_eq!(stations.news(), []);
        assert_eq!(stations.unresolved(MonoTime::default() + Span::from_s(60.0)), None);
    }

    #[test]
    fn a_station_that_cannot_be_reached_is_reported_once_and_counted() {
        // Given a good address, a name that does not exist, and a port that is never free.
        let mut stations = to(&["127.0.0.1:9", "no-such-host.invalid:14550", "127.0.0.1:0"]);
        for _ in 0..3 {
            stations.send(b"hello");
        }
        let all = stations.all().to_vec();
        assert_eq!((all[0].sent, all[0].failed, &all[0].fault), (3, 0, &None));
        assert_eq!((all[1].sent, all[1].failed), (0, 0));
        assert!(
            all[1].fault.as_ref().is_some_and(|fault| fault.starts_with("cannot be resolved")),
            "{:?}",
            all[1]
        );
        assert_eq!((all[2].sent, all[2].failed), (0, 3));
        assert!(all[2].words().contains("0 sent, 3 failed ("), "{}", all[2].words());
        // Then each fault is reported once, and the name is resolved again only after a while.
        let reported: Vec<String> = stations.news().into_iter().map(|news| news.name).collect();
        assert_eq!(reported, ["no-such-host.invalid:14550", "127.0.0.1:0"]);
        assert_eq!(stations.unresolved(MonoTime::default() + Span::from_s(1.0)), None);
        let again = stations.unresolved(MonoTime::default() + Span::from_s(11.0));
        assert_eq!(again, Some(vec!["no-such-host.invalid:14550".to_owned(), "127.0.0.1:0".to_owned()]));
    }
}
