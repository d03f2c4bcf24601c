//! Markers and ground features in frames.

#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod binarise;
mod codes;
mod components;
mod corners;
mod disc;
mod disc_pairs;
mod edge_points;
mod edges;
mod equations;
mod family;
mod features;
mod flow;
mod frame;
mod homography;
mod noise;
mod pattern;
mod payload;
mod pose;
mod pyramid;
mod quad;
mod refine;
mod simd;
mod tag;
mod tag_edges;
mod tag_model;
mod template;
mod windows;

pub use frame::FrameDetector;
pub use pattern::{TagPattern, tag_pattern};
pub use pose::{TagPose, TagPoses, tag_poses};
pub use simd::Simd;
pub use tag::{LARGEST_IMAGE_PX, Region, TagDetector};
