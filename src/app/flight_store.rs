//! Handle on the flight store, and the requests to the store's task.

use std::sync::Arc;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::io::store::StoreHandle;

/// The store while it runs; empty while it is closed because power is about to fail. Copies share the same store.
#[derive(Clone, Debug, Default)]
pub struct FlightStore(Arc<watch::Sender<Option<StoreHandle>>>);

impl FlightStore {
    /// The store, if it is running.
    pub fn get(&self) -> Option<StoreHandle> {
        self.0.borrow().clone()
    }

    /// Waits until the store is running.
    pub async fn opened(&self) -> StoreHandle {
        let mut changes = self.0.subscribe();
        loop {
            if let Some(store) = changes.borrow_and_update().clone() {
                return store;
            }
            if changes.changed().await.is_err() {
                return std::future::pending().await;
            }
        }
    }

    /// Replaces the store.
    pub(super) fn set(&self, handle: Option<StoreHandle>) {
        self.0.send_replace(handle);
    }
}

/// Requests to the store's task. Copies share the same requests.
#[derive(Clone, Debug, Default)]
pub struct StoreOrders {
    /// The pipeline has handed over its last output.
    pub pipeline_done: CancellationToken,
    /// Power is about to fail: close the flight and wait.
    pub power_going: Arc<watch::Sender<bool>>,
}
