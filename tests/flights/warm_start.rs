//! A pipeline that continues from the state of an earlier one.

use std::path::{Path, PathBuf};

use windhover::config::Config;
use windhover::io::capture::CaptureReader;
use windhover::pipeline::Pipeline;
use windhover_base::msg::{EstimatorOutput, Event, EventBody, Output, TrackStatus, WarmState};
use windhover_base::time::{MonoTime, Span};

fn capture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures/follow.mcap")
}

fn config() -> Config {
    windhover::app::replay::config_of(&capture()).expect("the capture has its configuration")
}

fn events() -> Vec<Event> {
    let reader = CaptureReader::open(&capture()).expect("the capture opens");
    reader.filter_map(|item| item.event).collect()
}

fn outputs(pipeline: &mut Pipeline, events: &[Event]) -> Vec<Output> {
    let mut out = Vec::new();
    events.iter().for_each(|event| pipeline.handle(event, &mut out));
    out.into_iter().map(|timed| timed.output).collect()
}

/// Times of the estimates with `tracking`, and their heading sigma in rad.
fn tracked(out: &[Output]) -> impl Iterator<Item = (MonoTime, f64)> {
    out.iter().filter_map(|o| match o {
        Output::Estimator(EstimatorOutput::Estimate(e)) if e.status == TrackStatus::Tracking => {
            let covariance = e.state?.covariance?;
            Some((e.t_valid, covariance[(2, 2)].sqrt()))
        }
        _ => None,
    })
}

/// The first half flown, and the state an operator's disk would hold then.
fn flown() -> (Vec<Event>, WarmState) {
    let events = events();
    let (before, after) = events.split_at(events.len() / 2);
    let mut pipeline = Pipeline::new((&config()).into());
    assert!(pipeline.warm_state().is_none(), "nothing is settled before the first event");
    outputs(&mut pipeline, before);
    let text =
        serde_json::to_string(&pipeline.warm_state().expect("the site is settled")).expect("plain values");
    (after.to_vec(), serde_json::from_str(&text).expect("what was written is read"))
}

/// The events of a run that begins with a state.
fn continued(warm: WarmState, after: &[Event]) -> Vec<Event> {
    let first = Event { t_recv: after[0].t_recv, seq: 0, body: EventBody::Warm(Box::new(warm)) };
    std::iter::once(first).chain(after.iter().cloned()).collect()
}

#[test]
fn a_restarted_pipeline_tracks_at_once_and_knows_its_sensors() {
    let (after, warm) = flown();
    let learnt = warm.filter.clone().expect("the filter had started");
    let begin = after[0].t_recv;
    let mut pipeline = Pipeline::new((&config()).into());
    let out = outputs(&mut pipeline, &continued(warm.clone(), &after));
    let (tracking, _) = tracked(&out).next().expect("it tracks again");
    assert!(tracking - begin < Span::from_s(2.0), "after {:?}", tracking - begin);
    let cold = outputs(&mut Pipeline::new((&config()).into()), &after);
    let (cold_tracking, cold_sigma) = tracked(&cold).next().expect("a cold one tracks too");
    assert!(tracking <= cold_tracking, "{tracking:?} warm, {cold_tracking:?} cold");
    let (_, sigma) = tracked(&out).find(|(t, _)| *t == cold_tracking).expect("it tracks at the same frame");
    assert!(sigma < cold_sigma, "{sigma} warm, {cold_sigma} cold");
    let datum = out.iter().find_map(|o| if let Output::Datum(_, d) = o { Some(*d) } else { None });
    assert_eq!(datum.map(|d| [d.lat_deg, d.lon_deg, d.height_m]), Some(warm.site.datum));
    let now = pipeline.warm_state().and_then(|w| w.filter).expect("it has started");
    for i in 0..learnt.mean.len() {
        let sigma = learnt.covariance[i][i].sqrt();
        assert!(
            (now.mean[i] - learnt.mean[i]).abs() < 4.0 * sigma + 1e-3,
            "state {i}: {now:?} after {learnt:?}"
        );
    }
}

#[test]
fn a_state_of_another_place_or_damaged_is_not_used() {
    let (after, warm) = flown();
    let cold = outputs(&mut Pipeline::new((&config()).into()), &after).len();
    let mut elsewhere = warm.clone();
    elsewhere.site.datum[0] += 1.0;
    elsewhere.arrivals.clear();
    elsewhere.filter.as_mut().expect("there is one").mean[3] = f64::NAN;
    let out = outputs(&mut Pipeline::new((&config()).into()), &continued(elsewhere, &after));
    assert_eq!(out.len(), cold);
    let frames = after.iter().filter(|e| matches!(e.body, EventBody::Frame(_))).count();
    assert!(frames > 10 && tracked(&out).next().is_some());
}
