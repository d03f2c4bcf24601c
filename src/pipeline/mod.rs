//! The one path from events to outputs, live and in replay.

pub mod frame;
mod output;
mod ticks;

pub use output::{Health, Notice, NoticeKind, Output, SourceHealth, TargetHealth};
pub use ticks::{TICK, Ticks};
