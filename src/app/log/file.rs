//! A log file that is rotated when it is large. `tracing-appender` rotates by the clock only and does not reopen a file
//! that something else has moved.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::app::events::OperatorEvent;

/// A log file with the rotated ones `NAME.1` (the newest), `NAME.2`, ….
pub(super) struct RotatingFile {
    path: PathBuf,
    limit_bytes: u64,
    kept: u32,
    current: Option<(File, u64)>,
    reopen: Arc<AtomicBool>,
    failed: bool,
}

impl RotatingFile {
    /// Opened with its first line; reopened with the next line after `reopen` was set.
    pub(super) fn new(path: &Path, limit_bytes: u64, kept: u32, reopen: Arc<AtomicBool>) -> Self {
        Self { path: path.to_owned(), limit_bytes, kept, current: None, reopen, failed: false }
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.reopen.swap(false, Ordering::AcqRel) {
            self.current = None;
        }
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
        file.write_all(bytes)?;
        *size += bytes.len() as u64;
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

impl Write for RotatingFile {
    /// Appends one line. The first failure of a row is an event for the other sinks.
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let appended = self.append(line);
        let failed_before = std::mem::replace(&mut self.failed, appended.is_err());
        if let Err(error) = &appended {
            self.current = None;
            if !failed_before {
                let path = self.path.display();
                OperatorEvent::LogFile.emit("", format_args!("cannot write {path}: {error}"));
            }
        }
        appended.map(|()| line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_put_aside_and_only_so_many_kept() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("log/windhover.log");
        let mut file = RotatingFile::new(&path, 50, 2, Arc::default());
        for n in 0..20 {
            file.write_all(format!("line {n:02} of a log\n").as_bytes()).expect("written");
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
        let reopen = Arc::new(AtomicBool::new(false));
        let mut file = RotatingFile::new(&path, 1_000, 1, reopen.clone());
        file.write_all(b"one\n").expect("written");
        std::fs::rename(&path, folder.path().join("moved")).expect("moved");
        reopen.store(true, Ordering::Release);
        file.write_all(b"two\n").expect("written");
        assert_eq!(std::fs::read_to_string(&path).expect("begun anew"), "two\n");
    }
}
