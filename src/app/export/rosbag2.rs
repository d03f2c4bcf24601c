//! A bag for ROS 2: outputs, frames and samples in ROS's types and frames.

use std::collections::BTreeSet;
use std::path::Path;

use super::{ExportError, Exported};
use crate::app::ros::RosTranslator;
use crate::config::Config;
use crate::io::capture::{CaptureReader, attached_config};
use crate::io::records::topic;
use crate::io::ros::Bag;

pub(super) use crate::io::ros::BAG_FILES as FILES;

pub(super) fn export(flight: &Path, out: &Path) -> Result<Exported, ExportError> {
    let config = attached_config(flight)?.and_then(|text| Config::parse(&text).ok());
    let mut reader = CaptureReader::open(flight)?;
    let mut ros = RosTranslator::new(config.as_ref());
    let mut bag = Bag::create(out)?;
    let (mut damaged, mut records) = (BTreeSet::new(), Vec::new());
    let mut outputs = false;
    for item in reader.by_ref() {
        match item.event {
            Some(event) => ros.event(&event, &mut records),
            None => {
                let name = item.raw.channel.topic.as_str();
                outputs |= topic::is_output(name);
                if let Err(error) = ros.output(name, item.raw.log_time, &item.raw.data, &mut records) {
                    damaged.insert(format!("messages on {name} are damaged and skipped: {error}"));
                }
            }
        }
        records.drain(..).try_for_each(|record| bag.write(&record))?;
    }
    let mut warnings = reader.take_warnings();
    warnings.extend(damaged);
    // A bag of frames alone would look like a flight in which nothing was seen.
    let files = if outputs { bag.finish()? } else { Vec::new() };
    Ok(Exported { files, warnings })
}
