//! The wireless link: QUIC with certificates on both sides, live datagrams, back-fill on streams.
//!
//! `docs/link.md` describes the message format and what is guaranteed.

pub mod keys;
pub mod tls;
