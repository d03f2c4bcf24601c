//! `[store]`: flights on the data card.

use serde::{Deserialize, Serialize};

/// `[store]`
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StoreConfig {
    /// Directory that holds `FLIGHTS/` and the index; the mount point of the data card.
    pub path: String,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self { path: "/var/lib/windhover".into() }
    }
}
