//! Sealing: a segment without its end, or with gaps, becomes one that every reader opens, with every complete chunk
//! kept.

use std::collections::{BTreeMap, BTreeSet};

use super::record::Definitions;
use super::scan::{Salvage, SegmentFile};
use super::segment::{Head, PAGE, put_head};
use super::summary::{PlacedChunk, Summary};
use super::volume::{StoreResult, Volume};
use super::{flight, format};

/// The result of sealing.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Sealing {
    /// It was already complete.
    Whole,
    /// Its end was missing and was written after the last complete chunk.
    Closed {
        /// Chunks kept.
        chunks: usize,
        /// Bytes after them that were not a complete chunk.
        cut_bytes: u64,
    },
    /// It had gaps and was written again.
    Rewritten {
        /// Chunks kept.
        chunks: usize,
        /// Bytes discarded.
        lost_bytes: u64,
    },
    /// It had no complete chunk and was removed.
    Removed,
}

/// Condition of a segment on the card.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Condition {
    /// Sealed, and consistent with its summary.
    Whole,
    /// Without its end, and complete up to there: the result of a kill or a power cut.
    CutOff {
        /// Complete chunks.
        chunks: usize,
        /// Bytes after them.
        cut_bytes: usize,
    },
    /// Different from what was written.
    Damaged,
}

/// Examines every byte of a segment.
pub fn condition(segment: &SegmentFile) -> Condition {
    let salvage = segment.salvage();
    if let Some(sealed) = segment.sealed() {
        return if segment.agrees(&sealed, &salvage) { Condition::Whole } else { Condition::Damaged };
    }
    let chunks = salvage.chunks.len();
    let end = salvage.last_commit_end.unwrap_or(salvage.chunks_end);
    let cut_bytes = usize::try_from(salvage.length.saturating_sub(end)).unwrap_or(usize::MAX);
    let is_whole = salvage.head_whole
        && salvage.config.is_some()
        && salvage.metadata.is_some()
        && salvage.head_definitions.agrees_with(&salvage.definitions)
        && salvage.contiguous;
    // Where there is no chunk, the head was still being written.
    if is_whole || chunks == 0 { Condition::CutOff { chunks, cut_bytes } } else { Condition::Damaged }
}

/// Seals one segment of a flight directory. `deep` also reads every chunk of one that looks complete.
pub fn seal_segment(volume: &Volume, dir: &str, name: &str, deep: bool) -> StoreResult<Sealing> {
    let path = format!("{dir}/{name}");
    let segment = SegmentFile::open(&volume.path(&path))?;
    let sealed = segment.sealed();
    if sealed.is_some() && !deep {
        return Ok(Sealing::Whole);
    }
    let mut salvage = segment.salvage();
    if let Some(sealed) = sealed {
        if segment.agrees(&sealed, &salvage) {
            return Ok(Sealing::Whole);
        }
        // The summary has a checksum, the head has none.
        let found = std::mem::replace(&mut salvage.definitions, sealed.definitions);
        salvage.definitions.complete_from(&found);
    }
    if salvage.chunks.is_empty() {
        volume.remove_file(&path)?;
        volume.sync_dir(dir)?;
        return Ok(Sealing::Removed);
    }
    let missing =
        |d: &Definitions| salvage.chunks.iter().flat_map(|c| c.messages.keys()).any(|id| !d.has(*id));
    if missing(&salvage.definitions) || salvage.config.is_none() || salvage.metadata.is_none() {
        complete_from_neighbours(volume, dir, name, &mut salvage);
    }
    let invented = invent_missing(&mut salvage);
    let head_holds = salvage.head_whole && salvage.head_definitions.agrees_with(&salvage.definitions);
    if head_holds && salvage.contiguous && !invented {
        close_in_place(volume, &path, &salvage)
    } else {
        rewrite(volume, dir, name, &segment, &salvage)
    }
}

/// Numbers are unique in a flight, so a lost head is restored from the neighbouring segments.
fn complete_from_neighbours(volume: &Volume, dir: &str, name: &str, salvage: &mut Salvage) {
    for other in flight::segment_names(&volume.path(dir)).iter().filter(|other| *other != name) {
        let Ok(file) = SegmentFile::open(&volume.path(&format!("{dir}/{other}"))) else { continue };
        let head = file.salvage_head_only();
        salvage.definitions.complete_from(&head.head_definitions);
        salvage.config = salvage.config.take().or(head.config);
        salvage.metadata = salvage.metadata.take().or(head.metadata);
        if let Some(sealed) = file.sealed() {
            salvage.definitions.complete_from(&sealed.definitions);
        }
    }
}

/// Messages of a channel without any definition are kept under a separate topic, so that every reader can read the
/// file.
fn invent_missing(salvage: &mut Salvage) -> bool {
    let used: BTreeSet<u16> = salvage.chunks.iter().flat_map(|c| c.messages.keys().copied()).collect();
    let missing: Vec<u16> = used.into_iter().filter(|id| !salvage.definitions.has(*id)).collect();
    for id in &missing {
        let channel = mcap::records::Channel {
            id: *id,
            schema_id: 0,
            topic: format!("/unknown/{id}"),
            message_encoding: String::new(),
            metadata: BTreeMap::new(),
        };
        salvage.definitions.channels.entry(*id).or_insert(channel).schema_id = 0;
    }
    !missing.is_empty()
}

fn close_in_place(volume: &Volume, path: &str, salvage: &Salvage) -> StoreResult<Sealing> {
    let mut summary = salvage.head.clone();
    let (last, earlier) = salvage.chunks.split_last().expect("a segment without chunks is removed");
    for chunk in earlier {
        summary.chunk(&mut Vec::new(), chunk.offset + chunk.length, chunk);
    }
    // Acknowledged data ends on a page and is not changed. Where the last commit is incomplete it was not acknowledged;
    // its chunk is complete, so its indexes are written again.
    let mut out = Vec::new();
    let end = match salvage.last_commit_end {
        Some(end) => {
            summary.chunk(&mut Vec::new(), last.offset + last.length, last);
            end
        }
        None => {
            summary.chunk(&mut out, salvage.chunks_end, last);
            format::pad_to_page(&mut out, salvage.chunks_end, PAGE);
            salvage.chunks_end
        }
    };
    summary.put_end(&mut out, end, &salvage.definitions);
    let mut file = volume.reopen(path, end)?;
    file.append(&out)?;
    file.sync()?;
    Ok(Sealing::Closed { chunks: salvage.chunks.len(), cut_bytes: salvage.length.saturating_sub(end) })
}

fn head_of(salvage: &Salvage) -> Head {
    Head {
        config: salvage.config.clone().unwrap_or_default(),
        metadata: salvage
            .metadata
            .clone()
            .unwrap_or_else(|| BTreeMap::from([("lost".into(), "head".into())])),
        time_ns: salvage.chunks.first().map_or(0, |c| c.header.message_start_time),
    }
}

fn rewrite(
    volume: &Volume,
    dir: &str,
    name: &str,
    segment: &SegmentFile,
    salvage: &Salvage,
) -> StoreResult<Sealing> {
    let temporary = format!("{dir}/{name}.repair");
    volume.remove_file(&temporary)?;
    let mut file = volume.create(&temporary)?;
    let mut summary = Summary::default();
    let mut out = Vec::new();
    put_head(&mut out, &mut summary, &head_of(salvage), &salvage.definitions);
    file.append(&out)?;
    let mut kept = 0;
    for chunk in &salvage.chunks {
        let mut out = segment.copy_out(chunk.offset, chunk.length)?;
        let placed = PlacedChunk { offset: file.len(), ..chunk.clone() };
        let start = file.len();
        summary.chunk(&mut out, start, &placed);
        format::pad_to_page(&mut out, start, PAGE);
        file.append(&out)?;
        kept += chunk.length;
    }
    let mut end = Vec::new();
    summary.put_end(&mut end, file.len(), &salvage.definitions);
    file.append(&end)?;
    file.sync()?;
    volume.replace(&temporary, &format!("{dir}/{name}"))?;
    volume.sync_dir(dir)?;
    Ok(Sealing::Rewritten { chunks: salvage.chunks.len(), lost_bytes: salvage.length.saturating_sub(kept) })
}
