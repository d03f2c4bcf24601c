//! `[store]`: flights on the data card.

use serde::{Deserialize, Serialize};

use super::ConfigError;
use super::check::{refuse, within};

/// Recorded video.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FramePolicy {
    /// JPEG of every frame; frames that the camera compressed are stored unchanged.
    #[default]
    Jpeg,
    /// Lossless, as PNG.
    Png,
    /// Lossless, the driver's bytes compressed with zstd: faster than PNG and a third larger.
    Zstd,
    /// JPEG of the region around the vehicle, the rest of the image flat grey; the whole image while no vehicle is
    /// seen.
    Region,
    /// No frames.
    None,
}

/// `[store]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StoreConfig {
    /// Whether flights are recorded.
    pub enabled: bool,
    /// Directory that holds `FLIGHTS/` and the index; the mount point of the data card.
    pub path: String,
    /// Whether `path` must be a mount point. Then a missing data card stops recording; otherwise recording would fill
    /// the system disk below the empty mount point.
    pub require_mount: bool,
    /// Recorded video: jpeg, png, zstd, region or none.
    pub frames: FramePolicy,
    /// One frame of this many is recorded.
    pub frames_every: u32,
    /// Quality of JPEG, 1 to 100.
    pub jpeg_quality: u8,
    /// With `frames = "region"`: margin around all detections of a vehicle, pixels.
    pub region_margin_px: u32,
    /// A segment ends after this many seconds …
    pub segment_s: f64,
    /// … or this many megabytes.
    pub segment_mb: u64,
    /// Recording stops while less than this is free, so that the card, its file system and the index never become full.
    pub free_floor_mb: u64,
    /// The oldest closed flights without `keep` are deleted so that this much is free, or a tenth of the card where
    /// that is less; 0 deletes nothing for space.
    pub free_target_mb: u64,
    /// All flights together may take this many gigabytes; 0 is no limit.
    pub max_gb: f64,
    /// Flights older than this many days are deleted; 0 is no limit.
    pub max_age_days: f64,
    /// Memory for data that the card has not taken yet, megabytes. When it is full, the oldest frames are dropped
    /// first, which is recorded.
    pub queue_mb: u64,
    /// Estimates that are kept for ground stations out of reach.
    pub backfill_records: u64,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            path: "/var/lib/windhover".into(),
            require_mount: false,
            frames: FramePolicy::Jpeg,
            frames_every: 1,
            jpeg_quality: 90,
            region_margin_px: 48,
            segment_s: 60.0,
            segment_mb: 512,
            free_floor_mb: 64,
            free_target_mb: 1024,
            max_gb: 0.0,
            max_age_days: 0.0,
            queue_mb: 64,
            backfill_records: 100_000,
        }
    }
}

impl StoreConfig {
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        if !self.path.starts_with('/') {
            refuse(
                "store.path",
                format!("{:?} is not absolute; give a path such as /var/lib/windhover", self.path),
            )?;
        }
        within("store.frames_every", f64::from(self.frames_every), 1.0, 10_000.0)?;
        within("store.jpeg_quality", f64::from(self.jpeg_quality), 1.0, 100.0)?;
        within("store.region_margin_px", f64::from(self.region_margin_px), 0.0, 4_096.0)?;
        within("store.segment_s", self.segment_s, 2.0, 3_600.0)?;
        within("store.segment_mb", self.segment_mb as f64, 1.0, 4_096.0)?;
        within("store.free_floor_mb", self.free_floor_mb as f64, 8.0, 1e6)?;
        within("store.free_target_mb", self.free_target_mb as f64, 0.0, 1e7)?;
        if self.free_target_mb != 0 && self.free_target_mb < self.free_floor_mb {
            refuse(
                "store.free_target_mb",
                "is below free_floor_mb; recording would stop before space is made",
            )?;
        }
        within("store.max_gb", self.max_gb, 0.0, 1e6)?;
        within("store.max_age_days", self.max_age_days, 0.0, 36_500.0)?;
        within("store.queue_mb", self.queue_mb as f64, 4.0, 4_096.0)?;
        within("store.backfill_records", self.backfill_records as f64, 0.0, 1e7)
    }
}
