//! The flight file of a replay: the messages of the recording, and new outputs.

use std::path::PathBuf;

use crate::app::sink::{OutgoingRecord, Sink};
use crate::io::mcap_read::RawMessage;
use crate::io::mcap_write::{Maker, McapFile, WriteError};
use crate::io::records::{self, topic};
use windhover_base::settings::CameraConfig;
use windhover_base::time::MonoTime;

/// Writes a flight: the file is created with the first message and gets its name when it is finished.
pub struct FlightFile {
    path: PathBuf,
    config_toml: String,
    camera: CameraConfig,
    writer: Option<McapFile>,
    fault: Option<WriteError>,
}

impl FlightFile {
    /// A flight at `path`, with the configuration attached.
    pub fn new(path: PathBuf, config_toml: String, camera: CameraConfig) -> Self {
        Self { path, config_toml, camera, writer: None, fault: None }
    }

    /// Copies a message of the recording, unless the replay makes a new one.
    ///
    /// # Errors
    /// The file cannot be made or written.
    pub fn copy(&mut self, raw: &RawMessage) -> Result<(), WriteError> {
        if self.writer.is_none() {
            self.begin(raw.log_time)?;
        }
        match &mut self.writer {
            Some(writer) if !topic::is_output(&raw.channel.topic) => writer.copy(raw),
            _ => Ok(()),
        }
    }

    fn begin(&mut self, t: MonoTime) -> Result<(), WriteError> {
        let writer = self.writer.insert(McapFile::create(&self.path, Maker::Replay, &self.config_toml, t)?);
        records::opening(&self.camera, t).iter().try_for_each(|record| writer.write(record))
    }

    /// Checks that everything passed to it so far was written.
    ///
    /// # Errors
    /// The first record that was not.
    pub fn check(&mut self) -> Result<(), WriteError> {
        self.fault.take().map_or(Ok(()), Err)
    }

    /// Ends the file.
    ///
    /// # Errors
    /// The rest cannot be written.
    pub fn finish(self) -> Result<(), WriteError> {
        self.writer.map_or(Ok(()), |writer| writer.close(&self.path))
    }
}

impl Sink for FlightFile {
    fn record(&mut self, record: &mut OutgoingRecord) {
        if let (Some(writer), None) = (&mut self.writer, &self.fault) {
            self.fault = writer.write(&record.record).err();
        }
    }
}
