//! The file operations of the data card. Every write, rename and sync of the store goes through here. It can fail with
//! a message that names it, and it can be logged so that a power cut at any point can be replayed (`journal`).

use std::fs::{File, OpenOptions};
use std::io::ErrorKind;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustix::fs::{FallocateFlags, RenameFlags};

use super::journal::{Journal, Op};

/// A file operation that failed.
#[derive(Debug, thiserror::Error)]
#[error("cannot {operation} {}: {source}", path.display())]
pub struct StoreError {
    /// The operation.
    pub operation: &'static str,
    /// Its path.
    pub path: PathBuf,
    /// The system's error.
    pub source: std::io::Error,
}

impl StoreError {
    /// Wraps the system's error.
    pub fn new(operation: &'static str, path: &Path, source: impl Into<std::io::Error>) -> Self {
        Self { operation, path: path.to_owned(), source: source.into() }
    }

    /// Whether the card is full.
    pub fn is_full(&self) -> bool {
        matches!(self.source.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded)
    }
}

/// Result of a file operation.
pub type StoreResult<T> = Result<T, StoreError>;

/// The file system of a path.
pub fn device_of(path: &Path) -> StoreResult<u64> {
    let metadata = std::fs::metadata(path).map_err(|e| StoreError::new("find the data card at", path, e))?;
    Ok(metadata.dev())
}

/// A directory tree on the card. Paths given to it are relative to its root.
#[derive(Clone, Debug)]
pub struct Volume {
    root: PathBuf,
    journal: Option<Arc<Journal>>,
}

impl Volume {
    /// The tree under `root`.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into(), journal: None }
    }

    /// The same, with every operation logged in `journal`.
    pub fn journaled(root: impl Into<PathBuf>, journal: Arc<Journal>) -> Self {
        Self { root: root.into(), journal: Some(journal) }
    }

    /// Its root directory.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The absolute path of a relative one.
    pub fn path(&self, relative: &str) -> PathBuf {
        self.root.join(relative)
    }

    /// The file system that is there now: a removed or exchanged card gives another one.
    pub fn device(&self) -> StoreResult<u64> {
        device_of(&self.root)
    }

    fn fault(&self) -> std::io::Result<()> {
        self.journal.as_ref().map_or(Ok(()), |journal| journal.fault())
    }

    fn note(&self, op: impl FnOnce() -> Op) {
        if let Some(journal) = &self.journal {
            journal.note(op());
        }
    }

    /// Makes a directory; an existing one is an error.
    pub fn create_dir(&self, relative: &str) -> StoreResult<()> {
        let path = self.path(relative);
        self.fault()
            .and_then(|()| std::fs::create_dir(&path))
            .map_err(|e| StoreError::new("create directory", &path, e))?;
        self.note(|| Op::CreateDir(relative.into()));
        Ok(())
    }

    /// Makes a directory where it is missing, durably.
    pub fn ensure_dir(&self, relative: &str, parent: &str) -> StoreResult<()> {
        if self.path(relative).is_dir() {
            return Ok(());
        }
        self.create_dir(relative)?;
        self.sync_dir(parent)
    }

    /// Makes a directory's entries durable.
    pub fn sync_dir(&self, relative: &str) -> StoreResult<()> {
        let path = self.path(relative);
        self.fault()
            .and_then(|()| File::open(&path)?.sync_all())
            .map_err(|e| StoreError::new("sync directory", &path, e))?;
        self.note(|| Op::SyncDir(relative.into()));
        Ok(())
    }

    /// Renames where the new name is free; `Ok(false)` where it is taken.
    pub fn rename_new(&self, from: &str, to: &str) -> StoreResult<bool> {
        let (old, new) = (self.path(from), self.path(to));
        let done = match rustix::fs::renameat_with(
            rustix::fs::CWD,
            &old,
            rustix::fs::CWD,
            &new,
            RenameFlags::NOREPLACE,
        ) {
            // A file system without the flag (vfat, some FUSE): check, then rename. No other process names flights
            // while the lock is held.
            Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) if !new.exists() => {
                std::fs::rename(&old, &new)
            }
            Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS | rustix::io::Errno::EXIST) => {
                return Ok(false);
            }
            other => other.map_err(Into::into),
        };
        done.map_err(|e| StoreError::new("rename", &old, e))?;
        self.note(|| Op::Rename { from: from.into(), to: to.into() });
        Ok(true)
    }

    /// Renames and replaces a file of the new name.
    pub fn replace(&self, from: &str, to: &str) -> StoreResult<()> {
        let old = self.path(from);
        self.fault()
            .and_then(|()| std::fs::rename(&old, self.path(to)))
            .map_err(|e| StoreError::new("rename", &old, e))?;
        self.note(|| Op::Rename { from: from.into(), to: to.into() });
        Ok(())
    }

    /// Removes a file; a missing one is no error.
    pub fn remove_file(&self, relative: &str) -> StoreResult<()> {
        let path = self.path(relative);
        match self.fault().and_then(|()| std::fs::remove_file(&path)) {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
            other => other.map_err(|e| StoreError::new("remove", &path, e))?,
        }
        self.note(|| Op::Remove(relative.into()));
        Ok(())
    }

    /// Removes a directory of files, files first.
    pub fn remove_dir(&self, relative: &str) -> StoreResult<()> {
        let path = self.path(relative);
        let entries = std::fs::read_dir(&path).map_err(|e| StoreError::new("read directory", &path, e))?;
        for entry in entries.flatten() {
            let name = entry.file_name();
            if entry.path().is_dir() {
                self.remove_dir(&format!("{relative}/{}", name.to_string_lossy()))?;
            } else {
                self.remove_file(&format!("{relative}/{}", name.to_string_lossy()))?;
            }
        }
        std::fs::remove_dir(&path).map_err(|e| StoreError::new("remove directory", &path, e))?;
        self.note(|| Op::Remove(relative.into()));
        Ok(())
    }

    /// Makes an empty file for appending; an existing one is an error.
    pub fn create(&self, relative: &str) -> StoreResult<AppendFile> {
        let path = self.path(relative);
        let file = self
            .fault()
            .and_then(|()| OpenOptions::new().write(true).create_new(true).open(&path))
            .map_err(|e| StoreError::new("create", &path, e))?;
        let id = self.journal.as_ref().map_or(0, |j| j.create(relative));
        Ok(AppendFile { file, path, id, journal: self.journal.clone(), length: 0, reserved: 0 })
    }

    /// Opens a file to continue after its first `length` bytes; the rest is cut off.
    pub fn reopen(&self, relative: &str, length: u64) -> StoreResult<AppendFile> {
        let path = self.path(relative);
        let file = OpenOptions::new()
            .write(true)
            .open(&path)
            .and_then(|file| file.set_len(length).map(|()| file))
            .map_err(|e| StoreError::new("reopen", &path, e))?;
        let id = self.journal.as_ref().map_or(0, |j| j.file_named(relative));
        self.note(|| Op::Truncate { file: id, length });
        Ok(AppendFile { file, path, id, journal: self.journal.clone(), length, reserved: 0 })
    }

    /// Writes a complete small file so that a reader finds the old or the new content, never a part.
    pub fn write_whole(&self, dir: &str, name: &str, bytes: &[u8]) -> StoreResult<()> {
        let whole = if dir.is_empty() { name.to_owned() } else { format!("{dir}/{name}") };
        let temporary = format!("{whole}.tmp");
        self.remove_file(&temporary)?;
        let mut file = self.create(&temporary)?;
        file.append(bytes)?;
        file.sync()?;
        self.replace(&temporary, &whole)?;
        self.sync_dir(dir)
    }

    /// Bytes that this process may still write, and the size of the file system.
    pub fn space(&self) -> StoreResult<(u64, u64)> {
        let stat = rustix::fs::statvfs(&self.root)
            .map_err(|e| StoreError::new("ask free space of", &self.root, e))?;
        let free = self.journal.as_ref().and_then(|journal| journal.free_bytes());
        Ok((free.unwrap_or(stat.f_bavail * stat.f_frsize), stat.f_blocks * stat.f_frsize))
    }
}

/// Whether an open file still has its path: the same device and inode, and any name at all.
pub fn same_file(file: &File, path: &Path) -> std::io::Result<()> {
    let open = file.metadata()?;
    let named = std::fs::metadata(path);
    if open.nlink() > 0 && named.is_ok_and(|named| (named.dev(), named.ino()) == (open.dev(), open.ino())) {
        return Ok(());
    }
    Err(std::io::Error::other("it was removed or replaced while it was written"))
}

/// A file that only grows. A failed append leaves its length unchanged.
#[derive(Debug)]
pub struct AppendFile {
    file: File,
    path: PathBuf,
    id: u64,
    journal: Option<Arc<Journal>>,
    length: u64,
    reserved: u64,
}

impl AppendFile {
    /// Bytes appended so far.
    pub fn len(&self) -> u64 {
        self.length
    }

    /// Whether nothing was appended yet.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// Its path at creation; a renamed directory is not followed.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Updates its path after a rename of its directory, for messages.
    pub fn set_path(&mut self, path: PathBuf) {
        self.path = path;
    }

    /// Appends all of `bytes`.
    pub fn append(&mut self, bytes: &[u8]) -> StoreResult<()> {
        let fault = self.journal.as_ref().map_or(Ok(()), |journal| journal.fault());
        if let Err(source) = fault.and_then(|()| self.file.write_all_at(bytes, self.length)) {
            // A partial append is cut off again so that the file ends on a complete record.
            let _ = self.file.set_len(self.length);
            return Err(StoreError::new("write", &self.path, source));
        }
        if let Some(journal) = &self.journal {
            journal.note(Op::Write { file: self.id, offset: self.length, bytes: bytes.to_vec() });
        }
        self.length += bytes.len() as u64;
        Ok(())
    }

    /// Reserves blocks up to `beyond` bytes after the end, `step` at a time, without changing the size. A file system
    /// that cannot do this is accepted.
    pub fn reserve(&mut self, beyond: u64, step: u64) -> StoreResult<()> {
        if self.length + beyond <= self.reserved {
            return Ok(());
        }
        let from = self.reserved.max(self.length);
        match rustix::fs::fallocate(&self.file, FallocateFlags::KEEP_SIZE, from, step.max(beyond)) {
            Ok(()) => self.reserved = from + step.max(beyond),
            Err(rustix::io::Errno::OPNOTSUPP | rustix::io::Errno::NOSYS) => self.reserved = u64::MAX,
            Err(e) => return Err(StoreError::new("reserve space for", &self.path, e)),
        }
        Ok(())
    }

    /// Makes everything appended durable. A file that no longer has its path is an error: what is written to it is
    /// lost, even if the system reports success.
    pub fn sync(&mut self) -> StoreResult<()> {
        self.file.sync_data().map_err(|e| StoreError::new("sync", &self.path, e))?;
        same_file(&self.file, &self.path).map_err(|e| StoreError::new("continue writing", &self.path, e))?;
        if let Some(journal) = &self.journal {
            journal.note(Op::Sync(self.id));
        }
        Ok(())
    }

    /// Returns blocks that were reserved and not used.
    pub fn release(&mut self) -> StoreResult<()> {
        self.file.set_len(self.length).map_err(|e| StoreError::new("trim", &self.path, e))?;
        self.reserved = 0;
        Ok(())
    }
}
