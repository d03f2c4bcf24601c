//! Headings from magnetic fields, for bags whose inertial samples have no attitude.

use nalgebra::{UnitQuaternion, Vector3};

use super::super::measured::{Measured, MeasuredLog};
use windhover_base::geo::{Geodetic, declination, ned_from_body_321, rot_x, rot_y, tilt_from_down};
use windhover_base::time::{MonoTime, Span, UtcTime};

/// Time over which specific forces are averaged: the average is gravity while the helicopter neither turns nor
/// accelerates.
const AVERAGED: Span = Span::from_ns(1_000_000_000);

/// Adds an attitude for every field of `topic`: tilt from the averaged specific force, heading from the field levelled
/// by it, true by the World Magnetic Model at the first fix. Nothing is added where attitudes exist or forces are
/// missing.
pub(super) fn headings(log: &mut MeasuredLog, topic: &str, fields: &[(MonoTime, Vector3<f64>)]) {
    if log.measured.iter().any(|(_, what)| matches!(what, Measured::Attitude(_))) {
        log.warnings.push(format!("magnetic fields on {topic} are not used: the bag has attitudes"));
        return;
    }
    let place = log.measured.iter().find_map(|(t, what)| match what {
        Measured::Fix(fix) => {
            Some((*t, Geodetic { lat_deg: fix.lat_deg, lon_deg: fix.lon_deg, height_m: fix.alt_m }))
        }
        _ => None,
    });
    let east_of_north = place.and_then(|(t, at)| declination(at, UtcTime::from_unix_ns(t.ns())).ok());
    if east_of_north.is_none() {
        log.warnings.push("the declination is not known (no fix, or a date the model does not cover): headings are magnetic".into());
    }
    let forces: Vec<(MonoTime, Vector3<f64>)> = log
        .measured
        .iter()
        .filter_map(|(t, what)| match what {
            Measured::Inertial(_, force) => Some((*t, *force)),
            _ => None,
        })
        .collect();
    let mut forces = forces.into_iter().peekable();
    let mut mean: Option<(MonoTime, Vector3<f64>)> = None;
    let mut attitudes = Vec::new();
    for (t, field) in fields {
        while let Some((at, force)) = forces.next_if(|(at, _)| at <= t) {
            let (last, before) = mean.unwrap_or((at, force));
            let share = ((at - last).s() / AVERAGED.s()).clamp(0.0, 1.0);
            mean = Some((at, before + (force - before) * share));
        }
        let Some(down) = mean.and_then(|(_, force)| (-force).try_normalize(1.0)) else { continue };
        let (pitch, roll) = tilt_from_down(&down);
        let level = rot_y(pitch) * rot_x(roll) * field;
        let heading = (-level.y).atan2(level.x) + east_of_north.unwrap_or(0.0);
        let attitude = ned_from_body_321(heading, pitch, roll);
        attitudes.push((*t, UnitQuaternion::from_rotation_matrix(&attitude)));
    }
    if attitudes.is_empty() {
        log.warnings.push(format!(
            "magnetic fields on {topic} are not used: without specific force the vertical is not known"
        ));
    }
    attitudes.into_iter().for_each(|(t, attitude)| log.push(t, Measured::Attitude(attitude), topic));
}
