//! The one path from events to outputs.
