//! Shared by the store's threads and its handles.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Mutex, MutexGuard, PoisonError, RwLock};

use super::frame_keeper::Region;
use super::index::Index;
use super::status::{StoreNotice, StoreStatus};
use windhover_base::time::UtcTime;

/// Shared by the store's threads and its handles.
#[derive(Debug)]
pub(super) struct StoreShared {
    status: Mutex<StoreStatus>,
    notices: SyncSender<StoreNotice>,
    index: RwLock<Option<Index>>,
    /// Start of the flight, once it is known, until it is used.
    start: Mutex<Option<UtcTime>>,
    region: Mutex<Option<Region>>,
    /// Number of the run; 0 until the card reported it.
    session: AtomicU32,
    stopping: AtomicBool,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl StoreShared {
    pub(super) fn new(notices: SyncSender<StoreNotice>) -> Self {
        Self {
            status: Mutex::default(),
            notices,
            index: RwLock::new(None),
            start: Mutex::default(),
            region: Mutex::default(),
            session: AtomicU32::new(0),
            stopping: AtomicBool::new(false),
        }
    }

    /// Sends a notice to the operator. Where nothing reads, the oldest notices are worth more: this one is dropped.
    pub(super) fn notice(&self, notice: StoreNotice) {
        let _ = self.notices.try_send(notice);
    }

    pub(super) fn status(&self) -> MutexGuard<'_, StoreStatus> {
        lock(&self.status)
    }

    pub(super) fn index(&self) -> Option<Index> {
        self.index.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(super) fn set_index(&self, index: Option<Index>) {
        self.status().index_ready = index.is_some();
        *self.index.write().unwrap_or_else(PoisonError::into_inner) = index;
    }

    pub(super) fn set_start(&self, start: UtcTime) {
        *lock(&self.start) = Some(start);
    }

    pub(super) fn start(&self) -> Option<UtcTime> {
        *lock(&self.start)
    }

    pub(super) fn set_region(&self, region: Option<Region>) {
        *lock(&self.region) = region;
    }

    pub(super) fn region(&self) -> Option<Region> {
        *lock(&self.region)
    }

    pub(super) fn session(&self) -> Option<u32> {
        Some(self.session.load(Ordering::Acquire)).filter(|s| *s != 0)
    }

    /// Sets the number of the run; only the first call counts.
    pub(super) fn settle_session(&self, session: u32) -> u32 {
        match self.session.compare_exchange(0, session, Ordering::AcqRel, Ordering::Acquire) {
            Ok(_) => session,
            Err(settled) => settled,
        }
    }

    pub(super) fn stop(&self) {
        self.stopping.store(true, Ordering::Release);
    }

    pub(super) fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }
}
