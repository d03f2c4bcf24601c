//! Metrics' sink: the latest health, for requests.

use std::sync::{Arc, Mutex, PoisonError};

use prost::Message as _;

use crate::app::sink::{OutgoingRecord, Sink};
use crate::io::proto::windhover::Health;
use crate::io::records::Schema;

/// The latest health, shared with the task that serves it.
#[derive(Clone, Debug, Default)]
pub struct LatestHealth(Arc<Mutex<Option<Health>>>);

impl LatestHealth {
    /// The latest health, once there is one.
    pub fn get(&self) -> Option<Health> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Keeps the latest health.
pub struct MetricsSink(LatestHealth);

impl MetricsSink {
    /// A sink into this place.
    pub fn new(latest: LatestHealth) -> Self {
        Self(latest)
    }
}

impl Sink for MetricsSink {
    fn record(&mut self, record: &mut OutgoingRecord) {
        if record.record.schema == Schema::Health
            && let Ok(health) = Health::decode(&record.record.data[..])
        {
            *self.0.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(health);
        }
    }
}
