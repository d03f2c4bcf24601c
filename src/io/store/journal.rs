//! A log of file operations, and the disk as a power cut at any point of it may leave it; also a card
//! that fails on demand.
//!
//! Of writes without a later barrier a card may keep none, all, the first ones, or any of their pages.
//! [`Journal::image`] builds each of these cases from the log; file content is durable after the file's sync, and names
//! after the directory's.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;

/// Bytes that a card writes or loses as a unit.
const PAGE: usize = 4096;

/// One file operation. Paths are relative to the volume.
#[derive(Clone, Debug)]
pub enum Op {
    /// A directory was made.
    CreateDir(String),
    /// An empty file was made.
    Create {
        /// Its number.
        file: u64,
        /// Its name.
        path: String,
    },
    /// Bytes were written.
    Write {
        /// The file.
        file: u64,
        /// The offset.
        offset: u64,
        /// The bytes.
        bytes: Vec<u8>,
    },
    /// A file was cut to a length.
    Truncate {
        /// The file.
        file: u64,
        /// Its new length.
        length: u64,
    },
    /// A file's content is durable.
    Sync(u64),
    /// A name changed.
    Rename {
        /// The old name.
        from: String,
        /// The new name; its previous file is gone.
        to: String,
    },
    /// A name was removed.
    Remove(String),
    /// A directory's entries are durable.
    SyncDir(String),
}

/// Which operations without a later barrier the card keeps.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Loss {
    /// None of them.
    FlushedOnly,
    /// All of them.
    Nothing,
    /// All but the last write, of which the first half of the bytes remains.
    TornTail,
    /// Any of their pages and names, chosen by this seed; the others read as zeros or are absent.
    Subset(u64),
}

#[derive(Debug, Default)]
struct Log {
    ops: Vec<Op>,
    files: u64,
    fault: Option<std::io::ErrorKind>,
    free_bytes: Option<u64>,
    held: bool,
}

/// The operations of a [`super::volume::Volume`], in order.
#[derive(Debug, Default)]
pub struct Journal {
    log: Mutex<Log>,
}

impl Journal {
    fn log(&self) -> std::sync::MutexGuard<'_, Log> {
        self.log.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    pub(super) fn note(&self, op: Op) {
        self.log().ops.push(op);
    }

    /// From now on every operation fails with this error, or works again.
    pub fn set_fault(&self, fault: Option<std::io::ErrorKind>) {
        self.log().fault = fault;
    }

    /// From now on this much is reported as free, or the true amount.
    pub fn set_free(&self, bytes: Option<u64>) {
        self.log().free_bytes = bytes;
    }

    /// From now on operations wait until they are released: a slow card.
    pub fn set_held(&self, held: bool) {
        self.log().held = held;
    }

    /// Before an operation: waits while the card is held, fails where a fault is set.
    pub(super) fn fault(&self) -> std::io::Result<()> {
        while self.log().held {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        self.log().fault.map_or(Ok(()), |kind| Err(kind.into()))
    }

    pub(super) fn free_bytes(&self) -> Option<u64> {
        self.log().free_bytes
    }

    pub(super) fn create(&self, path: &str) -> u64 {
        let mut log = self.log();
        log.files += 1;
        let file = log.files;
        log.ops.push(Op::Create { file, path: path.into() });
        file
    }

    /// The number of the file that has this name now; 0 where there is none.
    pub(super) fn file_named(&self, path: &str) -> u64 {
        let log = self.log();
        let mut disk = Disk::default();
        for op in &log.ops {
            disk.apply(op, true, &mut Chance(Loss::Nothing), false);
        }
        disk.names.get(path).copied().flatten().unwrap_or(0)
    }

    /// Adds the existing content of `root`, as durable.
    pub fn adopt(&self, root: &Path) -> std::io::Result<()> {
        self.adopt_dir(root, "")
    }

    fn adopt_dir(&self, root: &Path, dir: &str) -> std::io::Result<()> {
        for entry in std::fs::read_dir(root.join(dir))? {
            let entry = entry?;
            let name = entry.file_name().to_string_lossy().into_owned();
            let path = if dir.is_empty() { name } else { format!("{dir}/{name}") };
            if entry.path().is_dir() {
                self.note(Op::CreateDir(path.clone()));
                self.adopt_dir(root, &path)?;
            } else {
                let file = self.create(&path);
                self.note(Op::Write { file, offset: 0, bytes: std::fs::read(entry.path())? });
                self.note(Op::Sync(file));
            }
        }
        self.note(Op::SyncDir(dir.into()));
        Ok(())
    }

    /// Number of operations.
    pub fn len(&self) -> usize {
        self.log().ops.len()
    }

    /// Whether there was no operation.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes written so far.
    pub fn bytes_written(&self) -> u64 {
        let written = |op: &Op| if let Op::Write { bytes, .. } = op { bytes.len() as u64 } else { 0 };
        self.log().ops.iter().map(written).sum()
    }

    /// Builds under `root` the disk that a power cut after the first `cut` operations leaves.
    pub fn image(&self, cut: usize, loss: Loss, root: &Path) -> std::io::Result<()> {
        let ops = &self.log().ops[..];
        let ops = &ops[..cut.min(ops.len())];
        let mut disk = Disk::default();
        let last_write = ops.iter().rposition(|op| matches!(op, Op::Write { .. }));
        let mut chance = Chance(loss);
        for (at, op) in ops.iter().enumerate() {
            let durable = is_durable(ops, at);
            disk.apply(op, durable, &mut chance, Some(at) == last_write);
        }
        disk.write_out(root)
    }
}

/// Whether a barrier after operation `at` covers it. A name is covered by a sync of its directory; a journaling file
/// system also orders names, on which nothing here relies.
fn is_durable(ops: &[Op], at: usize) -> bool {
    let later = &ops[at + 1..];
    let dir_synced = |path: &str| {
        let parent = path.rsplit_once('/').map_or("", |(parent, _)| parent);
        later.iter().any(|op| matches!(op, Op::SyncDir(dir) if dir == parent))
    };
    match &ops[at] {
        Op::CreateDir(path) | Op::Create { path, .. } | Op::Remove(path) => dir_synced(path),
        Op::Rename { to, .. } => dir_synced(to),
        Op::Write { file, .. } | Op::Truncate { file, .. } => {
            later.iter().any(|op| matches!(op, Op::Sync(synced) if synced == file))
        }
        Op::Sync(_) | Op::SyncDir(_) => true,
    }
}

/// Decides which operations remain that are not durable.
struct Chance(Loss);

impl Chance {
    fn keeps(&mut self) -> bool {
        match &mut self.0 {
            Loss::FlushedOnly => false,
            Loss::Nothing | Loss::TornTail => true,
            Loss::Subset(state) => {
                // SplitMix64 (Steele, Lea and Flood 2014).
                *state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
                let mut z = *state;
                z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
                z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
                (z ^ (z >> 31)) & 1 == 0
            }
        }
    }
}

#[derive(Default)]
struct Disk {
    content: BTreeMap<u64, Vec<u8>>,
    /// Names of files (`Some`) and directories (`None`).
    names: BTreeMap<String, Option<u64>>,
}

impl Disk {
    fn apply(&mut self, op: &Op, durable: bool, chance: &mut Chance, last_write: bool) {
        match op {
            Op::CreateDir(path) if durable || chance.keeps() => {
                self.names.insert(path.clone(), None);
            }
            Op::Create { file, path } if durable || chance.keeps() => {
                self.names.insert(path.clone(), Some(*file));
            }
            Op::Rename { from, to } if durable || chance.keeps() => self.rename(from, to),
            Op::Remove(path) if durable || chance.keeps() => {
                let inside = format!("{path}/");
                self.names.retain(|name, _| name != path && !name.starts_with(&inside));
            }
            Op::Truncate { file, length } if durable || chance.keeps() => {
                self.content.entry(*file).or_default().truncate(*length as usize);
            }
            Op::Write { file, offset, bytes } => {
                let torn = !durable && last_write && chance.0 == Loss::TornTail;
                let bytes = if torn { &bytes[..bytes.len() / 2] } else { bytes };
                self.write(*file, *offset as usize, bytes, durable, chance);
            }
            _ => {}
        }
    }

    fn write(&mut self, file: u64, offset: usize, bytes: &[u8], durable: bool, chance: &mut Chance) {
        let content = self.content.entry(file).or_default();
        let mut at = 0;
        while at < bytes.len() {
            let page_end = (offset + at + 1).next_multiple_of(PAGE) - offset;
            let part = &bytes[at..page_end.min(bytes.len())];
            if durable || chance.keeps() {
                let end = offset + at + part.len();
                if content.len() < end {
                    content.resize(end, 0);
                }
                content[offset + at..end].copy_from_slice(part);
            }
            at += part.len();
        }
    }

    fn rename(&mut self, from: &str, to: &str) {
        let inside = format!("{from}/");
        let moved: Vec<_> =
            self.names.keys().filter(|n| *n == from || n.starts_with(&inside)).cloned().collect();
        for name in moved {
            if let Some(kind) = self.names.remove(&name) {
                self.names.insert(format!("{to}{}", &name[from.len()..]), kind);
            }
        }
    }

    fn write_out(&self, root: &Path) -> std::io::Result<()> {
        std::fs::create_dir_all(root)?;
        for (name, kind) in &self.names {
            let path = root.join(name);
            // A name below a lost directory is lost with it.
            if path.parent().is_some_and(|parent| !parent.is_dir()) {
                continue;
            }
            match kind {
                None => std::fs::create_dir_all(&path)?,
                Some(file) => std::fs::write(&path, self.content.get(file).map_or(&[][..], Vec::as_slice))?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::volume::Volume;
    use super::*;

    /// The content that a cut leaves of `F/a`, written in two appends of which only the first was synced.
    fn left(loss: Loss) -> Vec<u8> {
        let (live, image) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let journal = Arc::new(Journal::default());
        let volume = Volume::journaled(live.path(), Arc::clone(&journal));
        volume.create_dir("F").unwrap();
        volume.sync_dir("").unwrap();
        let mut file = volume.create("F/a").unwrap();
        file.append(&[1; 4096]).unwrap();
        file.sync().unwrap();
        volume.sync_dir("F").unwrap();
        file.append(&[2; 8192]).unwrap();
        volume.create("F/b").unwrap();
        journal.image(journal.len(), loss, image.path()).unwrap();
        assert_eq!(image.path().join("F/b").exists(), matches!(loss, Loss::Nothing | Loss::TornTail));
        std::fs::read(image.path().join("F/a")).unwrap()
    }

    #[test]
    fn what_no_barrier_covers_may_be_lost() {
        assert_eq!(left(Loss::FlushedOnly).len(), 4096);
        assert_eq!(left(Loss::Nothing).len(), 12288);
        assert_eq!(left(Loss::TornTail).len(), 8192);
    }
}
