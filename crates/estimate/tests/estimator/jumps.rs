//! A receiver whose position jumps: for good, and for a few fixes.

use windhover_base::geo::wrap_angle;
use windhover_base::msg::Ownship;
use windhover_base::time::MonoTime;
use windhover_estimate::EstimatorOutput;

use super::filter::{Flight, Input, estimates, fly, score};

/// Gives the fixes from each of `jumps` (seconds, metres north) on that much error on top, and as much
/// in height.
fn with_jumps(flight: &Flight, jumps: &[(f64, f64)]) -> Vec<EstimatorOutput> {
    let (mut filter, mut out) = (flight.filter(), Vec::new());
    for input in &flight.inputs {
        let mut input = input.clone();
        if let Input::Gnss(g) = &mut input {
            let t_s = flight.world.seconds(g.t_valid);
            let north_m = jumps.iter().rev().find(|(from_s, _)| t_s >= *from_s).map_or(0.0, |j| j.1);
            g.value.alt_msl_m = g.value.alt_msl_m.map(|alt| alt + north_m);
            g.value.lat_deg = g.value.lat_deg.map(|lat| lat + (north_m / METRES_A_RADIAN).to_degrees());
        }
        input.give(&mut filter, &mut out);
    }
    out
}

/// Radius of the earth along the meridian, m: within half a percent anywhere.
const METRES_A_RADIAN: f64 = 6.367e6;

fn ownships(out: &[EstimatorOutput]) -> Vec<Ownship> {
    out.iter().filter_map(|o| if let EstimatorOutput::Ownship(s) = o { Some(*s) } else { None }).collect()
}

fn anchorings(out: &[EstimatorOutput]) -> Vec<f64> {
    let by = |o: &EstimatorOutput| {
        if let EstimatorOutput::Anchored { moved_m } = o { Some(moved_m.x) } else { None }
    };
    out.iter().filter_map(by).collect()
}

#[test]
fn a_lasting_jump_of_the_receiver_anchors_the_scene_anew() {
    let flight = fly("follow", 40.0, 3, |_| {});
    let (straight, jumped) = (flight.outputs(), with_jumps(&flight, &[(15.0, 36.0), (27.0, 72.0)]));
    let moved = anchorings(&jumped);
    assert!(moved.len() == 2 && moved.iter().all(|m| (m - 36.0).abs() < 4.0), "{moved:?}");
    assert!(anchorings(&straight).is_empty());
    let off = |t: MonoTime| match flight.world.seconds(t) {
        s if s < 15.0 => Some(0.0),
        s if (17.0..27.0).contains(&s) => Some(36.0),
        s if s > 29.0 => Some(72.0),
        _ => None,
    };
    let gps = flight.rig();
    let prior_m = gps.gps.bias_sigma_m.hypot(gps.gps.noise_m);
    for own in ownships(&jumped).iter().filter(|o| flight.world.seconds(o.t_valid) > 6.0) {
        let truth = flight.world.ownship(own.t_valid);
        let Some(off_m) = off(own.t_valid) else { continue };
        let (error, sigma) = (own.position_ned_m - truth.position_ned_m, own.position_sigma_m());
        assert!((error.x - off_m).abs() < 4.0 * sigma.x && error.y.abs() < 4.0 * sigma.y, "{own:?}");
        // Tags show the height, whatever the receiver reports.
        assert!(error.z.abs() < 4.0 * sigma.z && error.z.abs() < 1.0, "{own:?}");
        assert!(sigma.x > 0.3 * prior_m && sigma.x < 1.2 * prior_m, "{sigma:?}");
    }
    // The vehicle went along, and nothing that does not depend on where the datum is noticed.
    for (a, b) in estimates(&straight).iter().zip(&estimates(&jumped)) {
        let (Some(a), Some(b), Some(off_m)) = (a.state, b.state, off(a.t_valid)) else { continue };
        assert!((b.north_m - a.north_m - off_m).abs() < 4.0 * prior_m, "{a:?} {b:?}");
        let turned = wrap_angle(b.heading_rad - a.heading_rad).abs();
        assert!(turned < 0.01 && (b.speed_mps - a.speed_mps).abs() < 0.03, "{a:?} {b:?}");
        assert!((b.yaw_rate_radps - a.yaw_rate_radps).abs() < 0.02, "{a:?} {b:?}");
    }
    let s = score(&estimates(&jumped), &flight.world, 6.0);
    assert!(s.nees < 6.0 && s.coverage > 0.98 && s.speed < 0.07 && s.yaw_rate < 0.045, "{s:?}");
}

#[test]
fn a_few_wrong_fixes_move_nothing() {
    let flight = fly("follow", 30.0, 3, |_| {});
    // Fixes come every 0.2 s: three of them.
    let (straight, jumped) = (flight.outputs(), with_jumps(&flight, &[(15.05, 36.0), (15.65, 0.0)]));
    assert!(anchorings(&jumped).is_empty());
    for (a, b) in ownships(&straight).iter().zip(&ownships(&jumped)) {
        assert!((a.position_ned_m - b.position_ned_m).norm() < 0.3, "{a:?} {b:?}");
    }
    for (a, b) in estimates(&straight).iter().zip(&estimates(&jumped)) {
        let (Some(a), Some(b)) = (a.state, b.state) else { continue };
        assert!(
            wrap_angle(b.heading_rad - a.heading_rad).abs() < 0.01
                && (b.speed_mps - a.speed_mps).abs() < 0.03
        );
    }
}
