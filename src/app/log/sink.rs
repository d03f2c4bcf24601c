//! Where lines go: standard error, the journal, a file that is put aside when it is large.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};

use super::line::Line;
use crate::config::{LogConfig, LogFormat};

/// The journal's socket for its native protocol.
const JOURNAL: &str = "/run/systemd/journal/socket";
/// The socket standard error is connected to where the service manager put it into the journal.
const JOURNAL_STREAM: &[u8] = b"/run/systemd/journal/stdout";

/// How lines leave the process.
pub(super) struct Sinks {
    screen: Screen,
    file: Option<RotatingFile>,
}

enum Screen {
    Text,
    Json,
    Journal(UnixDatagram),
}

impl Sinks {
    pub(super) fn new(config: &LogConfig) -> Self {
        let journal = || UnixDatagram::unbound().map_or(Screen::Text, Screen::Journal);
        let screen = match config.format {
            LogFormat::Text => Screen::Text,
            LogFormat::Json => Screen::Json,
            LogFormat::Journal => journal(),
            LogFormat::Auto if stderr_is_journal() => journal(),
            LogFormat::Auto => Screen::Text,
        };
        let file = config
            .file
            .as_ref()
            .map(|path| RotatingFile::new(Path::new(path), (config.file_mb * 1e6) as u64, config.files_kept));
        Self { screen, file }
    }

    /// Writes a line everywhere it goes. A sink that refuses is given up for this line: the log must
    /// not stop the daemon.
    pub(super) fn write(&mut self, line: &Line) {
        match &self.screen {
            Screen::Journal(socket) if socket.send_to(&line.journal(), JOURNAL).is_ok() => {}
            Screen::Text | Screen::Journal(_) => print(&line.text()),
            Screen::Json => print(&line.json()),
        }
        if let Some(file) = &mut self.file {
            let text = if matches!(self.screen, Screen::Json) { line.json() } else { line.text() };
            file.write(&text);
        }
    }

    /// Opens the file anew: something else may have moved it.
    pub(super) fn reopen(&mut self) {
        if let Some(file) = &mut self.file {
            file.current = None;
        }
    }
}

fn print(text: &str) {
    let mut out = io::stderr().lock();
    let _ = writeln!(out, "{text}");
}

/// Whether standard error is connected to the journal.
fn stderr_is_journal() -> bool {
    let stderr = io::stderr();
    let peer = rustix::net::getpeername(stderr.as_fd()).ok().flatten();
    let unix = peer.and_then(|address| rustix::net::SocketAddrUnix::try_from(address).ok());
    unix.is_some_and(|address| address.path_bytes() == Some(JOURNAL_STREAM))
}

/// A log file with those put aside as `NAME.1` (the newest), `NAME.2`, ….
struct RotatingFile {
    path: PathBuf,
    limit_bytes: u64,
    kept: u32,
    current: Option<(File, u64)>,
    complained: bool,
}

impl RotatingFile {
    fn new(path: &Path, limit_bytes: u64, kept: u32) -> Self {
        Self { path: path.to_owned(), limit_bytes, kept, current: None, complained: false }
    }

    fn write(&mut self, text: &str) {
        match self.try_write(text) {
            Ok(()) => self.complained = false,
            Err(error) => {
                self.current = None;
                if !std::mem::replace(&mut self.complained, true) {
                    print(&format!(
                        "level=warn event=log_file msg=\"cannot write {}: {error}\"",
                        self.path.display()
                    ));
                }
            }
        }
    }

    fn try_write(&mut self, text: &str) -> io::Result<()> {
        if self.current.as_ref().is_some_and(|(_, size)| *size >= self.limit_bytes) {
            self.current = None;
            self.put_aside()?;
        }
        let (file, size) = match &mut self.current {
            Some(current) => current,
            None => {
                if let Some(folder) = self.path.parent() {
                    std::fs::create_dir_all(folder)?;
                }
                let file = OpenOptions::new().create(true).append(true).open(&self.path)?;
                let size = file.metadata()?.len();
                self.current.insert((file, size))
            }
        };
        file.write_all(format!("{text}\n").as_bytes())?;
        *size += text.len() as u64 + 1;
        Ok(())
    }

    fn put_aside(&self) -> io::Result<()> {
        let numbered = |n: u32| {
            let mut name = self.path.clone().into_os_string();
            name.push(format!(".{n}"));
            PathBuf::from(name)
        };
        if self.kept == 0 {
            return std::fs::remove_file(&self.path);
        }
        for n in (1..self.kept).rev() {
            if numbered(n).exists() {
                std::fs::rename(numbered(n), numbered(n + 1))?;
            }
        }
        std::fs::rename(&self.path, numbered(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_put_aside_and_only_so_many_kept() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("log/windhover.log");
        let mut file = RotatingFile::new(&path, 50, 2);
        for n in 0..20 {
            file.write(&format!("line {n:02} of a log"));
        }
        let mut names: Vec<String> = std::fs::read_dir(path.parent().expect("a parent"))
            .expect("listed")
            .map(|entry| entry.expect("an entry").file_name().into_string().expect("a name"))
            .collect();
        names.sort();
        assert_eq!(names, ["windhover.log", "windhover.log.1", "windhover.log.2"]);
        let newest = std::fs::read_to_string(&path).expect("read");
        assert!(newest.ends_with("line 19 of a log\n"), "{newest}");
        let before = std::fs::read_to_string(folder.path().join("log/windhover.log.1")).expect("read");
        assert!(before.len() <= 50 + 17 && before.ends_with("log\n"), "{before}");
    }

    #[test]
    fn a_moved_file_is_begun_anew() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("w.log");
        let config = LogConfig { file: Some(path.to_string_lossy().into_owned()), ..LogConfig::default() };
        let mut sinks = Sinks::new(&config);
        let line =
            Line::new(windhover_base::time::MonoTime::from_ns(0), crate::config::LogLevel::Info, "started");
        sinks.write(&line);
        std::fs::rename(&path, folder.path().join("moved")).expect("moved");
        sinks.reopen();
        sinks.write(&line);
        assert_eq!(std::fs::read_to_string(&path).expect("begun anew").lines().count(), 1);
    }
}
