//! The edge: clock, serial, camera, captures, store, link.
