//! Markers and ground features in frames.
