//! Opening files whose names come from other people: a recording's segments and its terrain, a folder's images. Only
//! regular files are opened, without waiting; the size that is read has a limit.

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

/// Opens a regular file. A pipe, a device or a socket is refused without waiting for its other end.
///
/// # Errors
/// It is not a regular file, or the system's error.
pub fn open(path: &Path) -> io::Result<File> {
    let wait_for_nobody = rustix::fs::OFlags::NONBLOCK.bits();
    let file = OpenOptions::new().read(true).custom_flags(wait_for_nobody.cast_signed()).open(path)?;
    let there = file.metadata()?;
    if there.is_dir() {
        return Err(io::ErrorKind::IsADirectory.into());
    }
    if !there.is_file() {
        return Err(io::Error::other("it is not a regular file"));
    }
    Ok(file)
}

/// Reads a regular file of at most this many bytes.
///
/// # Errors
/// As [`open`]; it is longer.
pub fn read(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(most + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(io::Error::other(format!("it is longer than {} MB", most.div_ceil(1 << 20))));
    }
    Ok(bytes)
}

/// The same as text.
///
/// # Errors
/// As [`read`]; it is not UTF-8.
pub fn read_text(path: &Path, most: u64) -> io::Result<String> {
    String::from_utf8(read(path, most)?).map_err(|_| io::Error::other("it is not text (UTF-8)"))
}

/// The file of that name in a folder, with links resolved: it must be inside the folder.
///
/// # Errors
/// It is outside, or the system's error.
pub fn inside(folder: &Path, name: &str) -> io::Result<PathBuf> {
    let (folder, file) = (folder.canonicalize()?, folder.join(name).canonicalize()?);
    if file.starts_with(&folder) {
        return Ok(file);
    }
    Err(io::Error::other(format!("{name:?} is outside of {}", folder.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_inside_and_within_the_limit() {
        let dir = tempfile::tempdir().expect("a folder");
        let folder = dir.path().join("in");
        std::fs::create_dir(&folder).expect("made");
        std::fs::write(folder.join("a"), [1; 100]).expect("written");
        std::fs::write(dir.path().join("private"), "secret").expect("written");
        std::os::unix::fs::symlink("../private", folder.join("link")).expect("linked");
        let fifo = folder.join("fifo");
        rustix::fs::mkfifoat(rustix::fs::CWD, &fifo, rustix::fs::Mode::RWXU).expect("a pipe");
        // Opening a pipe that has no writer would wait.
        assert!(open(&fifo).expect_err("a pipe").to_string().contains("not a regular file"));
        assert!(open(Path::new("/dev/zero")).is_err() && open(&folder).is_err());
        assert_eq!(read(&folder.join("a"), 100).expect("it fits").len(), 100);
        assert!(read(&folder.join("a"), 99).is_err());
        assert!(inside(&folder, "a").is_ok() && inside(&folder, "./../in/a").is_ok());
        for outside in ["../private", "link", "/dev/zero"] {
            assert!(
                inside(&folder, outside).expect_err("outside").to_string().contains("is outside"),
                "{outside}"
            );
        }
    }
}
