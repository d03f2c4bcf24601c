//! Files of a recording: the file itself, or the segments of a flight's directory, each of them once.

use std::collections::BTreeMap;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::regular;

/// Bytes that are compared at a time.
const BLOCK: u64 = 1 << 16;

/// Files of a recording: the file itself, or the segments of a flight's directory in order of their names. Files whose
/// names begin with a dot are not segments (some systems write such a file beside each file), and a segment with
/// several names (a link, a copy) is read once, by the first of them.
///
/// # Errors
///
/// The system's error where the path cannot be read.
pub fn segment_files(path: &Path) -> io::Result<Vec<PathBuf>> {
    if !path.metadata()?.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let mut files = Vec::new();
    for entry in path.read_dir()? {
        let file = entry?.path();
        let hidden = file.file_name().is_none_or(|name| name.as_encoded_bytes().starts_with(b"."));
        if !hidden && file.extension().is_some_and(|e| e == "mcap") {
            files.push(file);
        }
    }
    files.sort();
    let mut by_length: BTreeMap<u64, Vec<PathBuf>> = BTreeMap::new();
    files.retain(|file| {
        let length = file.metadata().map_or(0, |file| file.len());
        let others = by_length.entry(length).or_default();
        // A file that cannot be compared is read, which reports the error.
        let again = others.iter().any(|other| is_same(other, file).unwrap_or(false));
        others.push(file.clone());
        !again
    });
    Ok(files)
}

/// Whether two files have the same bytes. Segments differ in their first blocks, which contain their numbers, so only
/// copies are read further. Two empty files are different.
fn is_same(one: &Path, other: &Path) -> io::Result<bool> {
    let (mut one, mut other) = (regular::open(one)?, regular::open(other)?);
    if one.metadata()?.len() == 0 {
        return Ok(false);
    }
    let (mut a, mut b) = (Vec::new(), Vec::new());
    loop {
        a.clear();
        b.clear();
        (&mut one).take(BLOCK).read_to_end(&mut a)?;
        (&mut other).take(BLOCK).read_to_end(&mut b)?;
        if a != b {
            return Ok(false);
        }
        if a.is_empty() {
            return Ok(true);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_segment_under_several_names_is_read_once_and_hidden_files_are_none() {
        let dir = tempfile::tempdir().expect("a folder");
        let at = |name: &str| dir.path().join(name);
        let long = vec![7_u8; 200_000];
        let differs_late = {
            let mut bytes = long.clone();
            *bytes.last_mut().expect("long") = 8;
            bytes
        };
        for (name, bytes) in [
            ("000000.mcap", &long),
            ("000000 (copy).mcap", &long),
            ("000001.mcap", &differs_late),
            ("._000001.mcap", &long),
            (".hidden.mcap", &differs_late),
            ("000002.mcap", &Vec::new()),
            ("000003.mcap", &Vec::new()),
            ("notes.txt", &long),
        ] {
            std::fs::write(at(name), bytes).expect("written");
        }
        std::os::unix::fs::symlink(at("000001.mcap"), at("000009.mcap")).expect("linked");
        std::fs::hard_link(at("000001.mcap"), at("000008.mcap")).expect("linked");
        let names: Vec<String> = segment_files(dir.path())
            .expect("segments")
            .iter()
            .map(|file| file.file_name().expect("a name").to_string_lossy().into_owned())
            .collect();
        assert_eq!(names, ["000000 (copy).mcap", "000001.mcap", "000002.mcap", "000003.mcap"]);
    }
}
