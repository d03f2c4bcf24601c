//! Shared by the targets.

use std::path::Path;

use windhover_decode::framed;

/// The lines as bodies of sentences, with checksums, which a fuzzer does not find.
pub fn sentences(lines: &[u8]) -> Vec<u8> {
    String::from_utf8_lossy(lines).lines().map(|body| framed(body) + "\r\n").collect::<String>().into_bytes()
}

/// Writes a file of these parts, in a file system in memory where there is one, and passes it on.
pub fn with_file(end: &str, parts: &[&[u8]], work: impl FnOnce(&Path)) {
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    let path = folder.join(format!("windhover-fuzz-{}.{end}", std::process::id()));
    std::fs::write(&path, parts.concat()).expect("a scratch file");
    work(&path);
    std::fs::remove_file(&path).expect("it is ours");
}
