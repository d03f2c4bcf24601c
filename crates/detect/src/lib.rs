#![doc = include_str!("../README.md")]
#![warn(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

mod binarise;
mod candidate;
mod components;
mod corners;
mod detection;
mod detector;
mod disc;
mod disc_pairs;
mod disjoint_sets;
mod edge_points;
mod edges;
mod equations;
mod family;
mod features;
mod flow;
mod homography;
mod noise;
mod pattern;
mod payload;
mod pixel_fit;
mod pixel_model;
mod pixel_patterns;
mod pixel_sums;
mod pose;
mod pyramid;
mod quad;
mod refine;
mod roi;
mod simd;
mod tag_edges;
mod tag_model;
mod template;
pub mod tracking;
mod windows;

pub use detection::TagDetection;
pub use detector::{Detector, LARGEST_IMAGE_PX, Limits};
pub use family::TagLayout;
pub use pattern::{TagPattern, tag_pattern};
pub use pose::{TagPose, TagPoses, tag_poses};
pub use roi::Roi;
pub use simd::Simd;
pub use windhover_base::geo::{CameraModel, LensModel};
pub use windhover_base::msg::{GrayImage, ImageView, TagFamily};
