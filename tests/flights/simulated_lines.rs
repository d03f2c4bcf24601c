//! The serial lines of simulated flights, decoded and put in time by the pipeline, against the truth.
//!
//! `cargo test --test flights simulated_lines -- --nocapture` prints the alignment errors of every source.

use std::sync::Arc;

use windhover::config::Config;
use windhover::pipeline::Pipeline;
use windhover_base::geo::wrap_angle;
use windhover_base::msg::{
    AttitudeSample, EventBody, GnssEpoch, NoticeKind, Output, SensorReading, Source, Stamped, TimedOutput,
};
use windhover_base::settings::CompassFormat;
use windhover_base::time::{MonoTime, Span};
use windhover_simulate::{Flight, FrameStorage, Sample, Scenario, SensorSuite, World};

/// Epochs and readings as the pipeline stamps them.
type Decoded = (Vec<Stamped<GnssEpoch>>, Vec<Stamped<AttitudeSample>>);

fn config_of(scenario: &Scenario) -> Config {
    Config::of_rig(scenario.rig.clone(), scenario.ground())
}

fn decoded(flight: Flight) -> Decoded {
    let mut pipeline = Pipeline::new((&config_of(flight.world().scenario())).into());
    let (mut outputs, mut fixes, mut attitudes) = (Vec::new(), Vec::new(), Vec::new());
    let mut sort = |outputs: &mut Vec<TimedOutput>| {
        for timed in outputs.drain(..) {
            match timed.output {
                Output::Reading(SensorReading::Gnss(fix)) => fixes.push(fix),
                Output::Reading(SensorReading::Attitude(attitude)) => attitudes.push(attitude),
                _ => {}
            }
        }
    };
    for event in flight {
        pipeline.handle(&event.expect("serial lines need no encoder"), &mut outputs);
        sort(&mut outputs);
    }
    pipeline.finish(&mut outputs);
    sort(&mut outputs);
    (fixes, attitudes)
}

/// Mean and rms about it.
fn spread(errors: &[f64]) -> (f64, f64) {
    let n = errors.len() as f64;
    let mean = errors.iter().sum::<f64>() / n;
    (mean, (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n).sqrt())
}

/// Readings with their true times, and frames' stamp errors (ms), of the same flight as values.
fn as_values(world: &Arc<World>) -> (Vec<(MonoTime, AttitudeSample)>, Vec<f64>) {
    let (mut readings, mut frames) = (Vec::new(), Vec::new());
    for sample in SensorSuite::new(Arc::clone(world)) {
        match sample {
            Sample::Attitude { t_true, stamped } => readings.push((t_true, stamped.value)),
            Sample::Frame { truth, .. } => frames.push((truth.t_stamp - truth.t_true).ms()),
            Sample::Gnss { .. } => {}
        }
    }
    (readings, frames)
}

fn nearest(readings: &[(MonoTime, AttitudeSample)], t: MonoTime) -> &(MonoTime, AttitudeSample) {
    let k = readings.partition_point(|(t_true, _)| *t_true < t);
    let around = &readings[k.saturating_sub(1)..(k + 1).min(readings.len())];
    around.iter().min_by_key(|(t_true, _)| (*t_true - t).abs()).expect("there are readings")
}

/// The jitter of arrivals is removed: what is left is this flight's constant error of the latency, which arrival times
/// cannot show, and little else. The fit settles in the first ten seconds.
#[test]
fn arrival_jitter_is_removed() {
    println!("flight  latency off by (gps, compass)  left after it: gps ms  compass ms  frame ms");
    for seed in 0..6 {
        let scenario = Scenario::named("follow").expect("known");
        let world = Arc::new(World::new(scenario, seed));
        let flight = Flight::new(Arc::clone(&world), FrameStorage::None, 1);
        let (gps_off, compass_off) = (flight.gps_latency_error(), flight.compass_latency_error());
        let (fixes, attitudes) = decoded(flight);
        let (readings, frames) = as_values(&world);
        let settled = world.time(10.0);

        let gps: Vec<f64> = fixes
            .iter()
            .filter(|fix| fix.t_valid > settled)
            .map(|fix| {
                let t_s = world.seconds_at_utc(fix.value.utc.expect("dated"));
                (fix.t_valid - world.time(t_s) - gps_off).ms()
            })
            .collect();
        let compass: Vec<f64> = attitudes
            .iter()
            .filter(|reading| reading.t_valid > settled)
            .map(|reading| {
                let t = reading.t_valid - compass_off;
                (t - nearest(&readings, t).0).ms()
            })
            .collect();
        assert!(gps.len() > 230 && compass.len() > 1_400, "{} fixes, {} readings", gps.len(), compass.len());
        let (gps, compass, frames) = (spread(&gps), spread(&compass), spread(&frames));
        println!(
            "{seed:6}  {:+6.1} {:+5.1} ms                {:+.2} ± {:.2}  {:+.2} ± {:.2}  {:+.2} ± {:.2}",
            gps_off.ms(),
            compass_off.ms(),
            gps.0,
            gps.1,
            compass.0,
            compass.1,
            frames.0,
            frames.1
        );
        assert!(gps.0.hypot(gps.1) < 2.0, "GPS: {gps:?} ms left of the jitter");
        assert!(compass.0.hypot(compass.1) < 2.0, "compass: {compass:?} ms left of the jitter");
        assert!(frames.0.hypot(frames.1) < 1.0, "frames: {frames:?} ms");
    }
}

/// Every compass format carries the same readings through its own sentences.
#[test]
fn every_compass_format_is_read_as_it_was_sent() {
    for format in CompassFormat::ALL {
        let mut scenario = Scenario::named("follow").expect("known");
        scenario.duration_s = 8.0;
        scenario.rig.compass.format = format;
        let world = Arc::new(World::new(scenario, 21));
        let flight = Flight::new(Arc::clone(&world), FrameStorage::None, 1);
        let off = flight.compass_latency_error();
        let (_, attitudes) = decoded(flight);
        let (readings, _) = as_values(&world);
        // The NMEA pair makes two samples a reading; every other format one.
        assert!(attitudes.len() >= 235, "{format:?}: {} readings", attitudes.len());
        let declination = world.scenario().declination_deg.to_radians();
        // Late enough for the fit to have settled to well within half a period.
        for sample in attitudes.iter().filter(|a| a.t_valid > world.time(4.0)) {
            let (t_true, sent) = nearest(&readings, sample.t_valid - off);
            assert!((sample.t_valid - off - *t_true).abs() < Span::from_ms(10.0), "{format:?}");
            if let Some(heading) = sample.value.heading {
                let magnetic = if sample.value.heading_is_true { heading - declination } else { heading };
                let wrong = wrap_angle(magnetic - sent.heading.expect("valid")).to_degrees();
                assert!(wrong.abs() < 0.06, "{format:?}: heading {wrong} degrees off");
            }
            if let (Some(tilt), Some(sent)) = (sample.value.tilt, sent.tilt) {
                let wrong = (tilt.pitch - sent.pitch).hypot(tilt.roll - sent.roll).to_degrees();
                assert!(wrong < 0.09, "{format:?}: tilt {wrong} degrees off");
            }
        }
        let has = |what: fn(&AttitudeSample) -> bool| attitudes.iter().any(|a| what(&a.value));
        // The line between two antennas has no tilt of its own, and a heading with an arbitrary zero is not used.
        assert_eq!(has(|a| a.tilt.is_some()), format != CompassFormat::Ubx, "{format:?}: tilt");
        assert_eq!(has(|a| a.heading.is_some()), format != CompassFormat::Bno08xRvc, "{format:?}: heading");
    }
}

/// One line for both: a receiver with two antennas, with heading packets between its sentences.
#[test]
fn a_receivers_line_may_tell_the_heading_too() {
    let mut scenario = Scenario::named("follow").expect("known");
    (scenario.duration_s, scenario.rig.compass.format) = (8.0, CompassFormat::Ubx);
    scenario.rig.compass.baud = scenario.rig.gps.baud;
    let world = Arc::new(World::new(scenario, 5));
    let mut config = config_of(world.scenario());
    config.compass.device.clone_from(&config.gps.device);
    let config = Config::parse(&config.to_toml().expect("writable")).expect("it is accepted");
    let mut pipeline = Pipeline::new((&config).into());
    let (mut outputs, mut packet) = (Vec::new(), Vec::new());
    for event in Flight::new(world, FrameStorage::None, 1) {
        let mut event = event.expect("serial lines need no encoder");
        if let EventBody::Bytes { source: source @ Source::Compass, data } = &mut event.body {
            // A packet of 64 bytes and what is around them goes out in one piece.
            packet.append(data);
            let whole = packet.len() / 72 * 72;
            (*source, *data) = (Source::Gps, packet.drain(..whole).collect());
        }
        pipeline.handle(&event, &mut outputs);
    }
    let count = |wanted: &dyn Fn(&Output) -> bool| outputs.iter().filter(|o| wanted(&o.output)).count();
    let headings =
        count(&|o| matches!(o, Output::Reading(SensorReading::Attitude(a)) if a.value.heading_is_true));
    let fixes = count(&|o| matches!(o, Output::Reading(SensorReading::Gnss(_))));
    assert!(headings >= 235 && fixes >= 38, "{headings} headings, {fixes} fixes");
    let complaint = |o: &Output| matches!(o, Output::Notice(n) if matches!(n.kind, NoticeKind::BytesRefused | NoticeKind::SourceSilent) && n.source != Some(Source::Camera));
    assert_eq!(count(&complaint), 0);
}

/// Sentences carry the receiver's result, to their number of digits.
#[test]
fn fixes_are_read_as_they_were_sent() {
    let world = Arc::new(World::new(Scenario::named("gps-outage").expect("known"), 8));
    let (fixes, _) = decoded(Flight::new(Arc::clone(&world), FrameStorage::None, 1));
    let sent: Vec<GnssEpoch> = SensorSuite::new(Arc::clone(&world))
        .filter_map(|sample| match sample {
            Sample::Gnss { stamped, .. } => Some(stamped.value),
            _ => None,
        })
        .collect();
    let mut compared = 0;
    for fix in &fixes {
        let same = sent.iter().find(|epoch| epoch.utc == fix.value.utc).expect("it was sent");
        assert_eq!(fix.value.fix, same.fix);
        let (Some(lat), Some(velocity)) = (same.lat_deg, same.vel_ned_mps) else { continue };
        assert!((fix.value.lat_deg.expect("a fix") - lat).abs() < 1e-9);
        assert!((fix.value.vel_ned_mps.expect("a fix") - velocity).norm() < 0.011);
        assert_eq!(
            fix.value.alt_msl_m.map(|x| (x * 10.0).round()),
            same.alt_msl_m.map(|x| (x * 10.0).round())
        );
        compared += 1;
    }
    assert!(compared > 260, "{compared} fixes compared of {}", sent.len());
}

/// The datum is still settled, and each is an event of its own.
#[test]
fn a_terrain_tile_that_is_missing_is_an_event_of_its_own() {
    // Given a configuration that names a terrain tile, and a pipeline that could not be given it.
    let mut scenario = Scenario::named("follow").expect("known");
    scenario.duration_s = 4.0;
    let world = Arc::new(World::new(scenario, 3));
    let mut config = config_of(world.scenario());
    config.ground.elevation_msl_m = None;
    config.ground.source = None;
    config.ground.terrain = Some("N30W086.hgt".into());
    let mut pipeline = Pipeline::new((&config).into());
    // When the first fixes come.
    let mut outputs = Vec::new();
    for event in Flight::new(world, FrameStorage::None, 1) {
        pipeline.handle(&event.expect("serial lines need no encoder"), &mut outputs);
    }
    // Then it is reported once, under its own name, and the datum is settled.
    let count = |kind: NoticeKind| {
        outputs.iter().filter(|o| matches!(&o.output, Output::Notice(notice) if notice.kind == kind)).count()
    };
    assert_eq!((count(NoticeKind::TerrainMissing), count(NoticeKind::DatumSet)), (1, 1));
}
