//! The edge: clock, serial, camera, captures, store, link.

pub mod autopilot;
pub mod camera;
pub mod capture;
pub mod clock;
pub mod device;
pub mod link;
pub mod import;
pub mod mcap_definitions;
pub mod mcap_read;
pub mod mcap_record;
pub mod mcap_write;
pub mod new_file;
pub mod notify;
pub mod power;
pub mod power_line;
pub mod pps;
pub mod process;
pub mod proto;
pub mod records;
pub mod regular;
pub mod ros;
pub mod segment_files;
pub mod serial;
pub mod store;
pub mod terrain;
pub mod mavlink;
