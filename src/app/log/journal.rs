//! The journal's native protocol. `tracing-journald` writes to the socket from the thread that emits, so a stuck
//! journal would hold it up; it hides what was lost, and its message lacks the event's name and fields, for which
//! people search.

use std::io;
use std::os::fd::AsFd;
use std::os::unix::net::UnixDatagram;

use super::line::{Line, shown};
use crate::config::LogLevel;

/// The journal's socket for its native protocol.
const SOCKET: &str = "/run/systemd/journal/socket";
/// The socket that standard error is connected to where the service manager sends it to the journal.
const STREAM: &[u8] = b"/run/systemd/journal/stdout";

/// A connection to the journal.
pub(super) struct Journal(UnixDatagram);

impl Journal {
    /// Probes with an empty datagram, which the journal discards; an error where there is no journal. A journal that
    /// does not accept it now exists.
    pub(super) fn open() -> io::Result<Self> {
        let socket = UnixDatagram::unbound()?;
        socket.set_nonblocking(true)?;
        match socket.send_to(&[], SOCKET) {
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error),
            _ => socket.set_nonblocking(false)?,
        }
        Ok(Self(socket))
    }

    /// Sends one entry; waits while the journal does not accept it.
    pub(super) fn send(&self, datagram: &[u8]) -> io::Result<()> {
        self.0.send_to(datagram, SOCKET).map(drop)
    }
}

/// Whether standard error is connected to the journal.
pub(super) fn is_stderr() -> bool {
    let stderr = io::stderr();
    let peer = rustix::net::getpeername(stderr.as_fd()).ok().flatten();
    let unix = peer.and_then(|address| rustix::net::SocketAddrUnix::try_from(address).ok());
    unix.is_some_and(|address| address.path_bytes() == Some(STREAM))
}

/// A line as a datagram: `MESSAGE`, `PRIORITY`, `SYSLOG_IDENTIFIER`, `WINDHOVER_EVENT`, and each field as
/// `WINDHOVER_NAME`. Source: systemd, "Native Journal Protocol".
pub(super) fn datagram(line: &Line) -> Vec<u8> {
    let mut out = Vec::with_capacity(512);
    put(&mut out, "MESSAGE", &line.logfmt());
    put(&mut out, "PRIORITY", priority(line.level));
    put(&mut out, "SYSLOG_IDENTIFIER", "windhover");
    put(&mut out, "WINDHOVER_EVENT", line.event);
    for (name, value) in line.context.iter().chain(&line.fields) {
        put(&mut out, &field_name(name), &shown(name, value));
    }
    out
}

/// syslog's priorities, as the journal takes them.
const fn priority(level: LogLevel) -> &'static str {
    match level {
        LogLevel::Error => "3",
        LogLevel::Warn => "4",
        LogLevel::Info => "6",
        LogLevel::Debug | LogLevel::Trace => "7",
    }
}

/// Upper case, and nothing but letters, digits and underscores.
fn field_name(name: &str) -> String {
    let clean = name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' });
    "WINDHOVER_".chars().chain(clean).collect()
}

fn put(out: &mut Vec<u8>, name: &str, value: &str) {
    out.extend_from_slice(name.as_bytes());
    if value.contains('\n') {
        out.push(b'\n');
        out.extend_from_slice(&(value.len() as u64).to_le_bytes());
    } else {
        out.push(b'=');
    }
    out.extend_from_slice(value.as_bytes());
    out.push(b'\n');
}

#[cfg(test)]
mod tests {
    use super::super::line::Value;
    use super::*;
    use windhover_base::time::MonoTime;

    #[test]
    fn fields_are_framed() {
        let line = Line {
            message: "a\nb".into(),
            fields: vec![("about", Value::Text("gps".into())), ("temp_c", Value::Figure(41.26))],
            context: vec![("flight", Value::Text("20261118T150405Z".into()))],
            ..Line::new(MonoTime::from_ns(0), LogLevel::Info, "device_up")
        };
        let datagram = String::from_utf8(datagram(&line)).expect("UTF-8");
        for part in [
            "MESSAGE=device_up msg=\"a\\nb\" about=gps temp_c=41.3\n",
            "PRIORITY=6\n",
            "WINDHOVER_EVENT=device_up\n",
            "WINDHOVER_TEMP_C=41.3\n",
            "WINDHOVER_ABOUT=gps\n",
            "WINDHOVER_FLIGHT=20261118T150405Z\n",
        ] {
            assert!(datagram.contains(part), "{datagram}");
        }
        let mut framed = Vec::new();
        put(&mut framed, "MESSAGE", "a\nb");
        assert_eq!(framed, b"MESSAGE\n\x03\0\0\0\0\0\0\0a\nb\n");
    }
}
