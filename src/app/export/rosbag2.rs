//! A bag for ROS 2: outputs, frames and samples in ROS's types and frames.

use std::collections::BTreeSet;
use std::path::Path;

use super::{ExportError, Exported};
use crate::app::refine::RefinedBeside;
use crate::app::ros::RosTranslator;
use crate::config::Config;
use crate::io::capture::{CaptureReader, attached_config};
use crate::io::mcap_read::RawMessage;
use crate::io::records::topic;
use crate::io::ros::{Bag, RosRecord};

pub(super) use crate::io::ros::BAG_FILES as FILES;

pub(super) fn export(flight: &Path, out: &Path) -> Result<Exported, ExportError> {
    let config = attached_config(flight)?.and_then(|text| Config::parse(&text).ok());
    let mut reader = CaptureReader::open(flight)?;
    let mut ros = RosTranslator::new(config.as_ref());
    let mut bag = Bag::create(out)?;
    let mut beside = RefinedBeside::of(flight);
    let (mut damaged, mut records) = (BTreeSet::new(), Vec::new());
    let mut outputs = false;
    let mut output = |raw: &RawMessage, ros: &mut RosTranslator, records: &mut Vec<RosRecord>| {
        let name = raw.channel.topic.as_str();
        if let Err(error) = ros.output(name, raw.log_time, &raw.data, records) {
            damaged.insert(format!("messages on {name} are damaged and skipped: {error}"));
        }
    };
    for item in reader.by_ref() {
        while let Some(refined) = beside.until(item.raw.log_time) {
            output(&refined, &mut ros, &mut records);
        }
        match item.event {
            Some(event) => ros.event(&event, &mut records),
            None => {
                outputs |= topic::is_output(&item.raw.channel.topic);
                output(&item.raw, &mut ros, &mut records);
            }
        }
        records.drain(..).try_for_each(|record| bag.write(&record))?;
    }
    for refined in beside.by_ref() {
        output(&refined, &mut ros, &mut records);
        records.drain(..).try_for_each(|record| bag.write(&record))?;
    }
    let mut warnings = reader.take_warnings();
    warnings.extend(beside.warning.take());
    warnings.extend(damaged);
    // A bag of frames alone would look like a flight in which nothing was seen.
    let files = if outputs { bag.finish()? } else { Vec::new() };
    Ok(Exported { files, warnings })
}
