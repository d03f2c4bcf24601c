//! The line over pseudo-terminals: bytes, disappearance and return of the device.

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

use serialport::TTYPort;
use tokio_util::sync::CancellationToken;

use windhover_decode::{ubx_framed, ubx_packets};

use super::*;

/// The far end of a pseudo-terminal and the name of its near end.
fn pty() -> (File, String) {
    let far: OwnedFd =
        openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("a pseudo-terminal");
    grantpt(&far).expect("granted");
    unlockpt(&far).expect("unlocked");
    let name = ptsname(&far, Vec::new()).expect("named").into_string().expect("ASCII");
    (File::from(far), name)
}

/// A running line: its reports, and the switch that ends it.
struct Line {
    reports: Receiver<Report>,
    stop: CancellationToken,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Line {
    fn start(device: &str, configure_garmin: bool) -> Self {
        Self::start_with(device, Framing::default(), configure_garmin.then_some(Setup::Garmin))
    }

    fn start_with(device: &str, framing: Framing, setup: Option<Setup>) -> Self {
        let settings = SerialSettings { device: device.to_owned(), baud: 38400, framing, text: true, setup };
        let (sender, reports) = channel();
        let stop = CancellationToken::new();
        let thread = std::thread::spawn({
            let stop = stop.clone();
            move || {
                let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
                let reports = move |report| drop(sender.send(report));
                let line = run(&settings, HostClock::start(), &reports);
                runtime.expect("a runtime").block_on(stop.run_until_cancelled(line));
            }
        });
        Self { reports, stop, thread: Some(thread) }
    }

    /// The first report that `wanted` accepts, within three seconds.
    fn wait<T>(&self, wanted: impl Fn(Report) -> Option<T>) -> T {
        for _ in 0..300 {
            if let Ok(report) = self.reports.recv_timeout(Duration::from_millis(100))
                && let Some(found) = wanted(report)
            {
                return found;
            }
        }
        panic!("the report did not come");
    }

    fn fault(&self) -> Fault {
        self.wait(|report| if let Report::Down(fault) = report { Some(fault) } else { None })
    }

    fn up(&self) {
        self.wait(|report| matches!(report, Report::Up(_)).then_some(()));
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.stop.cancel();
        if let Some(thread) = self.thread.take() {
            thread.join().expect("the line's thread ended");
        }
    }
}

#[test]
fn bytes_arrive_and_a_lost_line_comes_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let link: PathBuf = folder.path().join("gps");
    let (mut far, name) = pty();
    std::os::unix::fs::symlink(&name, &link).expect("linked");

    // Given a line by a stable name, when bytes are sent, then they are reported.
    let line = Line::start(&link.to_string_lossy(), false);
    line.up();
    far.write_all(b"$GPRMC").expect("sent");
    let received = line.wait(|r| if let Report::Bytes(_, bytes) = r { Some(bytes) } else { None });
    assert_eq!(received, b"$GPRMC");

    // When the far end disappears, then the fault is unplugged, then missing.
    std::fs::remove_file(&link).expect("unlinked");
    drop(far);
    assert_eq!(line.fault().kind, FaultKind::Unplugged);
    assert_eq!(line.fault().kind, FaultKind::Missing);

    // When it returns under another number, then it is used again.
    let (mut far, name) = pty();
    std::os::unix::fs::symlink(&name, &link).expect("linked");
    line.up();
    far.write_all(b"again").expect("sent");
    let received = line.wait(|r| if let Report::Bytes(_, bytes) = r { Some(bytes) } else { None });
    assert_eq!(received, b"again");
}

#[test]
fn a_held_port_is_busy_and_a_file_is_no_line() {
    let (_far, name) = pty();
    let held = TTYPort::open(&serialport::new(&name, 38400)).expect("opened");
    let line = Line::start(&name, false);
    assert_eq!(line.fault().kind, FaultKind::Busy);
    drop(held);
    line.up();

    let file = tempfile::NamedTempFile::new().expect("a file");
    let line = Line::start(&file.path().to_string_lossy(), false);
    assert_eq!(line.fault().kind, FaultKind::Failed);
}

#[test]
fn noise_tells_of_a_wrong_speed() {
    let (mut far, name) = pty();
    let line = Line::start(&name, false);
    line.up();
    let noise: Vec<u8> = (0..2000u32).map(|i| (i * 37 % 256) as u8).collect();
    far.write_all(&noise).expect("sent");
    let text = line.wait(|r| match r {
        Report::Note(NoteKind::Garbled, _, text) => Some(text),
        _ => None,
    });
    assert!(text.contains("38400 baud"), "{text}");
}

/// The bytes that arrive at the far end of a line, read by a separate thread.
fn received_at(far: &File) -> Receiver<Vec<u8>> {
    let mut reader = far.try_clone().expect("a second handle");
    let (sender, received) = channel();
    std::thread::spawn(move || {
        let mut buffer = [0; 256];
        while let Ok(count) = reader.read(&mut buffer) {
            if sender.send(buffer[..count].to_vec()).is_err() {
                return;
            }
        }
    });
    received
}

/// The present speed of a line, bits/s; zero where it cannot be known.
fn speed(line: &File) -> u32 {
    rustix::termios::tcgetattr(line).map_or(0, |line| line.output_speed())
}

/// A Garmin receiver at the far end of a line, which receives nothing and sends noise at any speed but its own. In
/// binary mode it handles packets only.
fn garmin_at(mut far: File, mut own: u32, mut binary: bool) {
    let asked = received_at(&far);
    std::thread::spawn(move || {
        let (mut received, mut commanded) = (String::new(), own);
        loop {
            let said = asked.recv_timeout(Duration::from_millis(200)).unwrap_or_default();
            if speed(&far) != own {
                received.clear();
                if far.write_all(&[0xf8, 0x00, 0x9e, 0xe6]).is_err() {
                    return;
                }
                continue;
            }
            if binary {
                binary = !said.windows(8).any(|bytes| bytes == [0x10, 0x0A, 2, 0x26, 0, 0xCE, 0x10, 3]);
                let position = [0x10, 0x33, 4, 0, 0x80, 0x3F, 0x12, 0x7A, 0x10, 3];
                if binary && far.write_all(&position).is_err() {
                    return;
                }
                continue;
            }
            received.push_str(&String::from_utf8_lossy(&said));
            let mut answers = garmin::sentence("GPRMC,150400.0,A,3842.2,N,00911.0,W,0,0,181126,,");
            while let Some((one, rest)) = received.split_once("\r\n") {
                let body = one.trim_start_matches('$').split('*').next().unwrap_or_default();
                match body.split(',').collect::<Vec<_>>().as_slice() {
                    ["PGRMC", .., "8"] => commanded = 38_400,
                    ["PGRMI", .., "R"] => own = commanded,
                    _ => {}
                }
                answers.push_str(&garmin::sentence(body));
                received = rest.to_owned();
            }
            if far.write_all(answers.as_bytes()).is_err() {
                return;
            }
        }
    });
}

/// The result of a receiver's configuration.
fn configured(report: Report) -> Option<String> {
    match report {
        Report::Note(NoteKind::Configured, _, text) => Some(text),
        _ => None,
    }
}

#[test]
fn a_receiver_at_another_speed_is_brought_to_the_configured_one() {
    let (far, name) = pty();
    garmin_at(far, 19_200, false);
    let line = Line::start(&name, true);
    line.up();
    let text = line.wait(configured);
    assert!(text.contains("used 19200 baud"), "{text}");
    assert_eq!(line.wait(configured), "7 settings accepted", "then it is configured at the new speed");
    line.wait(|r| matches!(r, Report::Bytes(_, bytes) if bytes.starts_with(b"$GPRMC")).then_some(()));
}

#[test]
fn a_receiver_left_in_binary_mode_is_set_to_nmea() {
    let (far, name) = pty();
    garmin_at(far, 38_400, true);
    let line = Line::start(&name, true);
    line.up();
    let text = line.wait(configured);
    assert!(text.contains("was in binary mode"), "{text}");
    line.wait(|r| matches!(r, Report::Bytes(_, bytes) if bytes.starts_with(b"$GPRMC")).then_some(()));
}

/// A u-blox receiver at the far end of a line, at its own speed; configured by keys, or by messages and ports.
fn ublox_at(mut far: File, mut own: u32, has_keys: bool) {
    let asked = received_at(&far);
    std::thread::spawn(move || {
        loop {
            let said = asked.recv_timeout(Duration::from_millis(100)).unwrap_or_default();
            let mut answers = Vec::new();
            if speed(&far) != own {
                answers.extend([0xf8, 0x00, 0x9e, 0xe6]);
            } else {
                answers.extend(ubx_framed(1, 7, &[0; 92]));
                for (class, identity, payload) in ubx_packets(&said) {
                    let knows = match (class, identity) {
                        (0x0A, 4) => continue,
                        (6, 0x8A) => has_keys,
                        _ => !has_keys,
                    };
                    answers.extend(ubx_framed(5, u8::from(knows), &[class, identity]));
                    match (identity, payload) {
                        (0x8A, [_, _, _, _, 1, 0, 0x52, 0x40, baud @ ..]) if knows => {
                            own = u32::from_le_bytes(baud.try_into().expect("a figure"));
                        }
                        (0x00, payload) if knows => {
                            own = u32::from_le_bytes(payload[8..12].try_into().expect("a figure"));
                        }
                        _ => {}
                    }
                }
            }
            if far.write_all(&answers).is_err() {
                return;
            }
        }
    });
}

#[test]
fn a_ublox_receiver_is_found_and_configured() {
    let start = |(own, has_keys, settings)| {
        let (far, name) = pty();
        ublox_at(far, own, has_keys);
        let setup = Setup::Ublox { rate_hz: 5.0, keep_text: false };
        (Line::start_with(&name, Framing::default(), Some(setup)), settings)
    };
    let lines = [(9_600, true, "13 settings"), (9_600, false, "10 settings")].map(start);
    for (line, settings) in lines {
        line.up();
        let text = line.wait(configured);
        assert!(text.contains("used 9600 baud"), "{text}");
        assert_eq!(line.wait(configured), format!("{settings} accepted"));
        line.wait(|r| matches!(r, Report::Bytes(_, bytes) if bytes.starts_with(&[0xB5, 0x62])).then_some(()));
    }
}

/// A pseudo-terminal always has eight data bits, and keeps the other settings.
#[test]
fn a_line_is_framed_as_configured() {
    use rustix::termios::ControlModes;
    for (framing, wanted) in [
        ("8N1", ControlModes::empty()),
        ("7O1", ControlModes::PARODD),
        ("8E2", ControlModes::CSTOPB),
        ("8O2", ControlModes::PARODD | ControlModes::CSTOPB),
    ] {
        let (far, name) = pty();
        let line = Line::start_with(&name, Framing::try_from(framing.to_owned()).expect("sound"), None);
        line.up();
        let set = rustix::termios::tcgetattr(&far).expect("its settings").control_modes;
        assert_eq!(set & (ControlModes::PARODD | ControlModes::CSTOPB), wanted, "{framing}");
    }
}

/// The bytes that a line reports, in one piece.
fn received(line: &Line, count: usize) -> Vec<u8> {
    let mut all = Vec::new();
    while all.len() < count {
        all.extend(line.wait(|r| if let Report::Bytes(_, bytes) = r { Some(bytes) } else { None }));
    }
    all
}

#[test]
fn a_device_behind_tcp_is_read_and_connected_anew() {
    let server = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let device = format!("tcp://{}", server.local_addr().expect("bound"));
    let line = Line::start(&device, false);
    let (mut peer, _) = server.accept().expect("connected");
    line.up();
    peer.write_all(b"$GPRMC").expect("sent");
    assert_eq!(received(&line, 6), b"$GPRMC");
    drop(peer);
    assert_eq!(line.fault().kind, FaultKind::Unplugged);
    let (mut peer, _) = server.accept().expect("connected again");
    line.up();
    peer.write_all(b"again").expect("sent");
    assert_eq!(received(&line, 5), b"again");
    drop((peer, server));
    assert_eq!(line.fault().kind, FaultKind::Unplugged);
    assert_eq!(line.fault().kind, FaultKind::Missing, "no program listens there any more");
}

#[test]
fn gpsd_is_asked_for_its_sentences() {
    let server = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let line = Line::start(&format!("tcp://{}", server.local_addr().expect("bound")), false);
    let (mut gpsd, _) = server.accept().expect("connected");
    line.up();
    gpsd.write_all(b"{\"class\":\"VERSION\",\"release\":\"3.25\"}\r\n").expect("sent");
    let wanted = b"?WATCH={\"enable\":true,\"json\":false,\"nmea\":true};\n";
    let mut asked = vec![0; wanted.len()];
    gpsd.read_exact(&mut asked).expect("asked");
    assert_eq!(asked, wanted);
}

#[test]
fn datagrams_are_read_from_whoever_sends_them() {
    let free = std::net::UdpSocket::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound");
    let line = Line::start(&format!("udp://{free}"), false);
    line.up();
    for text in [b"$GPGGA", b"$GPRMC"] {
        let sender = std::net::UdpSocket::bind("127.0.0.1:0").expect("a port");
        sender.send_to(text, free).expect("sent");
        assert_eq!(received(&line, 6), text);
    }
}
