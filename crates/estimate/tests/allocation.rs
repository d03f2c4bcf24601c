//! In steady state the estimator allocates nothing: what it needs, it has by then.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::Arc;

use windhover_base::geo::Ground;
use windhover_base::msg::{FrameObservations, FramePrediction, Stamped};
use windhover_base::settings::EstimatorConfig;
use windhover_estimate::{Estimator, EstimatorOutput, Site};
use windhover_simulate::{Sample, Scenario, SensorSuite, World};

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, which counts each thread's allocations.
struct Counting;

// SAFETY: every call is passed on unchanged to the system's allocator; the counter is a plain cell
// of the calling thread.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
        // SAFETY: the caller's obligations are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the pointer came from the system's allocator, by `alloc` above.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
        // SAFETY: as above.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations of the estimator alone, by second of a flight.
fn allocations(name: &str, seconds: f64) -> Vec<u64> {
    let mut scenario = Scenario::named(name).expect("a named scenario");
    scenario.duration_s = seconds;
    let declination_rad = scenario.declination_deg.to_radians();
    let world = Arc::new(World::new(scenario, 5));
    let site = Site { frame: *world.frame(), ground: Ground::Flat { down_m: 0.0 }, declination_rad };
    let mut filter = Estimator::new(&world.scenario().rig, &EstimatorConfig::default(), &site);
    let mut suite = SensorSuite::new(Arc::clone(&world));
    let mut out: Vec<EstimatorOutput> = Vec::with_capacity(1024);
    let mut expected = FramePrediction::default();
    let mut seen = FrameObservations::default();
    let mut counted = vec![0; seconds.ceil() as usize + 2];
    while let Some(sample) = suite.next() {
        seen.clone_from(suite.observations());
        let before = ALLOCATIONS.get();
        match &sample {
            Sample::Gnss { stamped, .. } => filter.gnss(stamped, &mut out),
            Sample::Attitude { stamped, .. } => filter.attitude(stamped, &mut out),
            Sample::Frame { truth, seq } => {
                filter.predict(truth.t_stamp, &mut expected);
                let value = std::mem::take(&mut seen);
                let frame = Stamped { t_valid: truth.t_stamp, t_recv: truth.t_recv, seq: *seq, value };
                filter.frame(&frame, &mut out);
                seen = frame.value;
            }
        }
        let second = world.seconds(sample.t_recv()).max(0.0) as usize;
        counted[second] += ALLOCATIONS.get() - before;
        out.clear();
    }
    counted
}

#[test]
fn nothing_is_allocated_in_steady_state() {
    for name in ["follow", "two-vehicles", "noisy"] {
        let counted = allocations(name, 25.0);
        assert!(counted[..5].iter().sum::<u64>() > 0, "{name}: the counter does not count");
        assert_eq!(counted[10..].iter().sum::<u64>(), 0, "{name}: {counted:?}");
    }
}
