//! Flights through the pipeline and the commands: simulated, imported, calibrated with, continued.

mod borders;
mod calibration_doc;
mod closed_loop;
mod compass_conventions;
mod contract;
mod import;
mod no_camera;
mod refine;
mod samples;
mod silent_camera;
mod simulated_lines;
mod warm_start;
