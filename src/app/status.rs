//! Status that the tasks share: values of the running daemon, and the pipeline's health.

use std::sync::{Arc, Mutex, PoisonError};

use windhover_base::msg::Health;

use super::health::Figures;

/// Status that the tasks share. Copies share the same status.
#[derive(Clone, Debug, Default)]
pub struct SharedStatus(Arc<Mutex<Status>>);

/// What is shared.
#[derive(Clone, Debug, Default)]
pub struct Status {
    /// Values that only a running daemon has. Each task writes its own.
    pub figures: Figures,
    /// The pipeline's last health. The pipeline's task writes it.
    pub health: Option<Health>,
    /// How the last flight ended: as text, or why its end is not on the card. The store's task writes it; `None` where
    /// nothing is recorded.
    pub outcome: Option<Result<String, String>>,
}

impl SharedStatus {
    /// Reads or changes the status under its lock.
    pub fn with<T>(&self, access: impl FnOnce(&mut Status) -> T) -> T {
        access(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}
