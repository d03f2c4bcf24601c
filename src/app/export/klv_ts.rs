//! The film of a flight: H.264 in an MPEG transport stream, with its metadata.

use std::io::{BufWriter, Write as _};
use std::path::Path;

use super::{ExportError, Exported, write_error};
use crate::app::film::{Film, Known};
use crate::config::Config;
use crate::io::capture::{CaptureReader, attached_config};
use crate::io::mcap_read::McapReader;
use crate::io::new_file::NewFile;
use windhover_base::msg::EventBody;

/// Its file, and the generator's name near the start of the file.
pub(super) const FILE: (&str, &str) = ("flight.ts", "windhover");

pub(super) fn export(flight: &Path, mut reader: McapReader, out: &Path) -> Result<Exported, ExportError> {
    let config = attached_config(flight)?.and_then(|text| Config::parse(&text).ok());
    let mut known = Known::new(config.as_ref().map_or(&[], |config| &config.target));
    for message in reader.by_ref() {
        known.message(&message.channel.topic, &message.data);
    }
    let mut exported = Exported { files: Vec::new(), warnings: reader.take_warnings() };
    if known.utc_minus_host_ns.is_none() {
        exported
            .warnings
            .push("the receiver never reported the date: times of the packets are the host's".into());
    }
    let mission = flight.file_stem().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let mut film = Film::new(mission, config.map(|config| config.camera), None, known);
    let path = out.join(FILE.0);
    let (mut file, mut unusable) = (None, 0);
    for item in CaptureReader::open(flight)? {
        let Some(EventBody::Frame(frame)) = item.event.map(|event| event.body) else { continue };
        let Some(frame) = film.frame(&frame)? else {
            unusable += 1;
            continue;
        };
        let file = match &mut file {
            Some(file) => file,
            none => none.insert(BufWriter::new(NewFile::create(&path).map_err(|e| write_error(&path, e))?)),
        };
        file.write_all(&frame.ts).map_err(|e| write_error(&path, e))?;
    }
    if unusable > 0 {
        exported
            .warnings
            .push(format!("{unusable} frames cannot be decoded or have another size: they are left out"));
    }
    let file = file.ok_or_else(|| ExportError::NoFrames { path: flight.to_owned() })?;
    let whole = file.into_inner().map_err(|error| error.into_error()).and_then(NewFile::finish);
    whole.map_err(|source| write_error(&path, source))?;
    exported.files.push(path);
    Ok(exported)
}
