//! Output files of commands. A file has a temporary name until it is complete. No input is overwritten, and no file
//! that this program did not make.

use std::collections::BTreeSet;
use std::fs::{File, OpenOptions};
use std::io::{self, Read as _, Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use super::regular;
use super::segment_files::segment_files;

/// A mark of this program is within this many bytes of a file's start.
const MARK_WITHIN: u64 = 1 << 12;

/// A file being written under a temporary name, renamed when it is complete. If dropped before, nothing remains.
#[derive(Debug)]
pub struct NewFile {
    file: File,
    place: PathBuf,
    /// The temporary file; `None` for devices and pipes, which are written to directly.
    beside: Option<PathBuf>,
}

impl NewFile {
    /// Creates a file that will be at `place`; a symbolic link is followed.
    ///
    /// # Errors
    /// The system's error; a directory is not a file.
    pub fn create(place: &Path) -> io::Result<Self> {
        let place = place.canonicalize().unwrap_or_else(|_| place.to_owned());
        match place.metadata() {
            Ok(there) if there.is_dir() => return Err(io::ErrorKind::IsADirectory.into()),
            Ok(there) if !there.is_file() => {
                let file = OpenOptions::new().write(true).open(&place)?;
                return Ok(Self { file, place, beside: None });
            }
            _ => {}
        }
        let name = place.file_name().ok_or(io::ErrorKind::InvalidInput)?;
        for attempt in 0.. {
            let mut beside = name.to_owned();
            beside.push(format!(".{}-{attempt}.part", std::process::id()));
            let beside = place.with_file_name(beside);
            match OpenOptions::new().read(true).write(true).create_new(true).open(&beside) {
                Ok(file) => return Ok(Self { file, place, beside: Some(beside) }),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
        }
        unreachable!("some number is free")
    }

    /// Gives the complete file its name.
    ///
    /// # Errors
    /// It cannot be synced or renamed; an earlier file of that name remains.
    pub fn finish(mut self) -> io::Result<()> {
        let Some(beside) = &self.beside else { return self.file.flush() };
        self.file.sync_data()?;
        std::fs::rename(beside, &self.place)?;
        self.beside = None;
        Ok(())
    }

    /// Writes a complete file.
    ///
    /// # Errors
    /// As [`Self::create`] and [`Self::finish`].
    pub fn write(place: &Path, content: &[u8]) -> io::Result<()> {
        let mut file = Self::create(place)?;
        file.write_all(content)?;
        file.finish()
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        if let Some(beside) = &self.beside {
            // The temporary file was not completed; where it cannot be removed its name ends with .part.
            let _ = std::fs::remove_file(beside);
        }
    }
}

impl Write for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for NewFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

/// Why an output cannot be at the requested place.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// It is an input.
    #[error("{} is an input; choose another file for the output", path.display())]
    OverInput {
        /// The output.
        path: PathBuf,
    },
    /// It would become a part of the input.
    #[error("{} would become a segment of the flight that is read; write to another directory", path.display())]
    InFlight {
        /// The output.
        path: PathBuf,
    },
    /// It is a directory.
    #[error("{} is a directory; name a file", path.display())]
    Directory {
        /// The output.
        path: PathBuf,
    },
}

/// The inputs of a command, by device and inode: every file, every segment of a flight.
#[derive(Clone, Debug, Default)]
pub struct Inputs {
    files: BTreeSet<(u64, u64)>,
    flights: BTreeSet<(u64, u64)>,
}

fn identity(path: &Path) -> Option<(u64, u64)> {
    path.metadata().ok().map(|there| (there.dev(), there.ino()))
}

impl Inputs {
    /// Inputs for these files and flights. A file that does not exist cannot be overwritten.
    pub fn of<'a>(paths: impl IntoIterator<Item = &'a Path>) -> Self {
        let mut inputs = Self::default();
        for path in paths {
            let segments = segment_files(path).unwrap_or_default();
            if path.is_dir() && !segments.is_empty() {
                inputs.flights.extend(identity(path));
            }
            inputs.files.extend(identity(path));
            inputs.files.extend(every_file(path).iter().filter_map(|file| identity(file)));
        }
        inputs
    }

    /// Whether an output may be at this place.
    ///
    /// # Errors
    /// The reason why it may not.
    pub fn allow(&self, output: &Path) -> Result<(), PlaceError> {
        let path = output.to_owned();
        if identity(output).is_some_and(|there| self.files.contains(&there)) {
            return Err(PlaceError::OverInput { path });
        }
        if output.is_dir() {
            return Err(PlaceError::Directory { path });
        }
        let folder = match output.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        let is_segment = output.extension().is_some_and(|end| end == "mcap");
        if is_segment && identity(folder).is_some_and(|there| self.flights.contains(&there)) {
            return Err(PlaceError::InFlight { path });
        }
        Ok(())
    }
}

/// The files of a folder (of a flight, of images), whatever their names.
fn every_file(path: &Path) -> Vec<PathBuf> {
    let entries = path.read_dir().into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|file| file.is_file()).collect()
}

/// Whether the file at a place may be overwritten without a question: it does not exist, is empty, is no regular file,
/// or was written by an earlier run of the same command, which is recognised by all of the `marks` near its start.
pub fn is_free(place: &Path, marks: &[&str]) -> bool {
    let Ok(there) = place.metadata() else { return true };
    if !there.is_file() || there.len() == 0 {
        return true;
    }
    let mut begin = Vec::new();
    let read = regular::open(place).and_then(|file| file.take(MARK_WITHIN).read_to_end(&mut begin));
    let holds = |mark: &&str| begin.windows(mark.len()).any(|part| part == mark.as_bytes());
    read.is_ok() && marks.iter().all(holds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_finished_leaves_what_was_there() {
        let dir = tempfile::tempdir().expect("a folder");
        let (place, link) = (dir.path().join("out"), dir.path().join("link"));
        std::fs::write(&place, "before").expect("written");
        std::os::unix::fs::symlink(&place, &link).expect("linked");
        let mut file = NewFile::create(&link).expect("created");
        file.write_all(b"half").expect("written");
        drop(file);
        assert_eq!(std::fs::read(&place).expect("there"), b"before");
        NewFile::write(&link, b"whole").expect("written");
        assert_eq!(std::fs::read(&place).expect("there"), b"whole");
        assert!(link.is_symlink(), "the link is still there");
        assert_eq!(dir.path().read_dir().expect("listed").count(), 2, "no temporary file remains");
        NewFile::write(Path::new("/dev/null"), b"nothing").expect("a device accepts it");
        assert!(NewFile::create(dir.path()).is_err());
    }

    #[test]
    fn no_name_of_an_input_is_an_output() {
        let dir = tempfile::tempdir().expect("a folder");
        let at = |name: &str| dir.path().join(name);
        std::fs::create_dir(at("flight")).expect("made");
        for name in ["flight/000000.mcap", "flight/._000001.mcap", "capture.mcap"] {
            std::fs::write(at(name), "bytes").expect("written");
        }
        std::fs::hard_link(at("flight/000000.mcap"), at("hard.mcap")).expect("linked");
        std::os::unix::fs::symlink(at("capture.mcap"), at("soft.mcap")).expect("linked");
        std::os::unix::fs::symlink(at("flight"), at("way")).expect("linked");
        let inputs = Inputs::of([at("flight").as_path(), at("capture.mcap").as_path()]);
        let over = [
            "flight/000000.mcap",
            "flight/._000001.mcap",
            "hard.mcap",
            "soft.mcap",
            "way/000000.mcap",
            "flight",
        ];
        for name in over {
            assert!(matches!(inputs.allow(&at(name)), Err(PlaceError::OverInput { .. })), "{name}");
        }
        assert!(matches!(inputs.allow(&at("way/000009.mcap")), Err(PlaceError::InFlight { .. })));
        assert!(matches!(inputs.allow(dir.path()), Err(PlaceError::Directory { .. })));
        inputs.allow(&at("flight/report.html")).expect("a report beside the segments");
        inputs.allow(&at("new.mcap")).expect("a new file");
    }

    #[test]
    fn only_what_the_same_command_made_is_free() {
        let dir = tempfile::tempdir().expect("a folder");
        let at = |name: &str, content: &str| {
            let path = dir.path().join(name);
            std::fs::write(&path, content).expect("written");
            path
        };
        let marks = ["windhover ", " replay"];
        assert!(is_free(&dir.path().join("none"), &marks));
        assert!(is_free(&at("empty", ""), &marks));
        assert!(is_free(&at("ours", "MCAP windhover 0.1 replay …"), &marks));
        assert!(!is_free(&at("card", "MCAP windhover 0.1 …"), &marks));
        assert!(!is_free(&at("letter", "Dear windhover"), &marks));
        assert!(is_free(Path::new("/dev/null"), &marks));
    }
}
