//! `[link]`: the wireless link.

use serde::{Deserialize, Serialize};

/// `[link]`
#[derive(Clone, PartialEq, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LinkConfig {
    /// Whether the payload opens the link at all.
    pub enabled: bool,
}
