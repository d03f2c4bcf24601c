//! A refined flight as MCAP: the flight without its pictures, with a refined estimate beside each estimate.

use std::path::Path;

use nalgebra::{UnitQuaternion, Vector3};
use prost::Message;

use super::words::{constant_words, in_unit, seen_name, source_name};
use super::{RefineFlightError, RefinedFlight};
use crate::io::mcap_read::McapReader;
use crate::io::mcap_write::{Maker, McapFile};
use crate::io::proto::{foxglove as fox, timestamp, windhover as wh};
use crate::io::records::{Record, Schema, location, ownship, target_state, topic, transform};
use windhover_base::geo::rot_z;
use windhover_base::msg::{Ownship, TargetEstimate};
use windhover_base::time::MonoTime;

/// Writes everything of the flight at `from` except its pictures, with the result, to `to`.
pub(super) fn write(done: &RefinedFlight, from: &Path, to: &Path) -> Result<(), RefineFlightError> {
    let text = done.config.to_toml().unwrap_or_default();
    let mut file = McapFile::create(to, Maker::Refine, &text, done.flight.began)?;
    let mut records = records(done).into_iter().peekable();
    for raw in McapReader::open(from)? {
        while let Some(record) = records.next_if(|record| record.log_time <= raw.log_time) {
            file.write(&record)?;
        }
        let schema = raw.channel.schema.name.as_str();
        let picture =
            matches!(schema, "foxglove.CompressedImage" | "foxglove.RawImage" | "foxglove.CompressedVideo");
        if !picture && !topic::is_refined(&raw.channel.topic) {
            file.copy(&raw)?;
        }
    }
    records.try_for_each(|record| file.write(&record))?;
    Ok(file.close(to)?)
}

/// The result's messages, in order of time.
fn records(done: &RefinedFlight) -> Vec<Record> {
    let mut records = Vec::new();
    for (_, own) in &done.refined.own {
        own_records(own, &mut records);
    }
    for (_, estimate) in &done.refined.targets {
        target_records(estimate, &done.config.target[estimate.target].name, &mut records);
    }
    records.sort_by_key(|record| record.log_time);
    let end = done.refined.own.last().map_or(done.flight.ended, |(_, own)| own.t_valid);
    records.push(record(topic::REFINED.to_owned(), Schema::Refined, end, &summary(done, end)));
    records
}

fn own_records(own: &Ownship, out: &mut Vec<Record>) {
    let t = own.t_valid;
    out.push(record(topic::OWNSHIP_REFINED.to_owned(), Schema::Ownship, t, &ownship(own)));
    let tf = transform(t, "ned", "refined/body", own.position_ned_m, &own.ned_from_body);
    out.push(record(topic::TF.to_owned(), Schema::FrameTransform, t, &tf));
}

fn target_records(estimate: &TargetEstimate, name: &str, out: &mut Vec<Record>) {
    let t = estimate.t_valid;
    let message = target_state(estimate, name);
    out.push(record(topic::target_refined(name), Schema::TargetState, t, &message));
    let Some(state) = &estimate.state else { return };
    let frame = format!("refined/target/{name}");
    let place: fox::LocationFix = location(t, &frame, state);
    out.push(record(topic::target_refined_location(name), Schema::LocationFix, t, &place));
    let at = Vector3::new(state.north_m, state.east_m, 0.0);
    let turned = UnitQuaternion::from_rotation_matrix(&rot_z(state.heading_rad));
    let tf = transform(t, "ned", &frame, at, &turned);
    out.push(record(topic::TF.to_owned(), Schema::FrameTransform, t, &tf));
}

fn record(topic: String, schema: Schema, t: MonoTime, message: &impl Message) -> Record {
    Record { topic: topic.into(), schema, log_time: t, publish_time: t, data: message.encode_to_vec() }
}

/// What the flight shows about its configuration, as a message.
fn summary(done: &RefinedFlight, end: MonoTime) -> wh::Refined {
    let (refined, targets) = (&done.refined, &done.config.target[..]);
    let constants = refined.constants.iter().filter(|constant| constant.prior_sigma > 0.0);
    let sources = refined.tallies.iter().map(|tally| wh::RefinedSource {
        name: source_name(tally.source, targets),
        taken: tally.taken as u64,
        outliers: tally.outliers as u64,
        noise_factor: tally.figure.sqrt(),
    });
    let outliers = refined.outliers.iter().map(|outlier| wh::RefinedOutlier {
        timestamp: Some(timestamp(outlier.t)),
        source: source_name(outlier.source, targets),
        marker: outlier.marker.map_or(String::new(), seen_name),
        ratio: outlier.ratio,
    });
    wh::Refined {
        timestamp: Some(timestamp(end)),
        constants: constants
            .map(|constant| {
                let words = constant_words(constant.kind, targets);
                let [value, sigma, expected, expected_sigma] = in_unit(constant, &words);
                let (name, unit, told) = (words.name, words.unit.into(), constant.is_determined());
                wh::RefinedConstant { name, unit, value, sigma, expected, expected_sigma, told }
            })
            .collect(),
        sources: sources.collect(),
        outliers: outliers.collect(),
        features: refined.features.0 as u64,
        features_moving: refined.features.1 as u64,
        remarks: done.remarks.clone(),
    }
}
