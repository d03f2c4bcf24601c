//! A refinement that stands beside its flight, for readers of the flight.

use std::iter::Peekable;
use std::path::Path;

use super::beside;
use crate::io::mcap_read::{McapReader, RawMessage};
use crate::io::records::topic;
use windhover_base::time::MonoTime;

/// The messages of `FLIGHT.refined.mcap` on the topics of a refinement, in order of time; none where there is no such
/// file, the flight was changed after it, or it cannot be read.
pub struct RefinedBeside {
    messages: Peekable<Box<dyn Iterator<Item = RawMessage>>>,
    /// Why the file is not used, for the user.
    pub warning: Option<String>,
}

impl RefinedBeside {
    /// Of this flight.
    pub fn of(flight: &Path) -> Self {
        let path = beside(flight);
        let changed = |path: &Path| path.metadata().and_then(|file| file.modified()).ok();
        let (mut warning, mut messages): (_, Box<dyn Iterator<Item = RawMessage>>) =
            (None, Box::new(std::iter::empty()));
        match (path.is_file(), changed(&path) >= changed(flight)) {
            (true, true) => match McapReader::open(&path) {
                Ok(reader) => {
                    messages = Box::new(reader.filter(|raw| topic::is_refined(&raw.channel.topic)));
                }
                Err(error) => {
                    warning = Some(format!("the refinement beside the flight is not used: {error}"))
                }
            },
            (true, false) => {
                let name = path.display();
                warning =
                    Some(format!("{name} is older than the flight and not used: refine the flight again"));
            }
            (false, _) => {}
        }
        Self { messages: messages.peekable(), warning }
    }

    /// The next message, if it is not later than `t`.
    pub fn until(&mut self, t: MonoTime) -> Option<RawMessage> {
        self.messages.next_if(|raw| raw.log_time <= t)
    }
}

impl Iterator for RefinedBeside {
    type Item = RawMessage;

    fn next(&mut self) -> Option<RawMessage> {
        self.messages.next()
    }
}
