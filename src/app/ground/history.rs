//! What a station's files contain of the past, by payload and topic.

use std::path::Path;

use super::mirror::{RUN_FILE, messages};
use windhover_base::time::MonoTime;

/// A record from the files.
#[derive(Clone, PartialEq, Debug)]
pub struct Past<'a> {
    /// Name of the payload.
    pub payload: &'a str,
    /// Topic of the flight.
    pub topic: &'a str,
    /// Name of the schema.
    pub schema_name: &'a str,
    /// Run of the payload.
    pub run: u32,
    /// Number in the run.
    pub number: u32,
    /// Its time of validity, in the payload's host time.
    pub t: MonoTime,
    /// The protobuf message.
    pub data: &'a [u8],
}

fn subdirectories(dir: &Path) -> Vec<(String, std::path::PathBuf)> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let mut found: Vec<_> = entries
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .filter_map(|entry| Some((entry.file_name().into_string().ok()?, entry.path())))
        .collect();
    found.sort();
    found
}

/// Passes every record of the payloads that `wanted` selects, as far as it is on the disk, in the order of the files,
/// to `give`, until that returns that it is enough.
pub fn read(root: &Path, wanted: impl Fn(&str) -> bool, mut give: impl FnMut(&Past<'_>) -> bool) {
    for (payload, dir) in subdirectories(root).iter().filter(|(name, _)| wanted(name)) {
        for (_, flight) in subdirectories(dir) {
            let text = std::fs::read_to_string(flight.join(RUN_FILE)).unwrap_or_default();
            let Ok(run) = u32::from_str_radix(text.trim(), 16) else { continue };
            for message in messages(&flight) {
                let past = Past {
                    payload,
                    topic: &message.channel.topic,
                    schema_name: &message.channel.schema.name,
                    run,
                    number: message.sequence,
                    t: message.publish_time,
                    data: &message.data,
                };
                if !give(&past) {
                    return;
                }
            }
        }
    }
}
