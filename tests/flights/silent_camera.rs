//! A camera that stops: targets coast and are lost after their time, live and in replay alike.

use std::path::Path;

use windhover::app::replay::config_of;
use windhover::config::Config;
use windhover::io::capture::CaptureReader;
use windhover::pipeline::Pipeline;
use windhover_base::msg::{
    EstimatorOutput, Event, EventBody, Health, NoticeKind, Output, TargetEstimate, TimedOutput, TrackStatus,
};
use windhover_base::time::{MonoTime, Span};

/// The capture's configuration with a time out of sight of two seconds, and its events without frames after `s`.
fn flight_without_frames_after(s: f64) -> (Config, Vec<Event>, MonoTime) {
    let capture = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures/follow.mcap");
    let mut config = config_of(&capture).expect("the capture has its configuration");
    config.estimator.lost_after_s = 2.0;
    let reader = CaptureReader::open(&capture).expect("the capture opens");
    let events: Vec<Event> = reader.filter_map(|item| item.event).collect();
    let cut = events[0].t_recv + Span::from_s(s);
    let kept = |event: &Event| event.t_recv < cut || !matches!(event.body, EventBody::Frame(_));
    (config, events.into_iter().filter(kept).collect(), cut)
}

fn fly(config: &Config, events: &[Event]) -> Vec<TimedOutput> {
    let (mut pipeline, mut out) = (Pipeline::new(config.into()), Vec::new());
    events.iter().for_each(|event| pipeline.handle(event, &mut out));
    out
}

fn coasted(out: &[TimedOutput]) -> Vec<TargetEstimate> {
    let of = |timed: &TimedOutput| match &timed.output {
        Output::Estimator(EstimatorOutput::Coasted(estimate)) => Some(*estimate),
        _ => None,
    };
    out.iter().filter_map(of).collect()
}

#[test]
fn targets_coast_and_are_lost_without_a_frame() {
    // Given a vehicle that is tracked, when the camera gives no more frames.
    let (config, events, cut) = flight_without_frames_after(3.0);
    let out = fly(&config, &events);
    let coasted = coasted(&out);
    // Then it is predicted ten times a second from half a second on, with no smaller sigma than before, and lost after
    // its time, once. (GPS and compass may meanwhile reduce the sigma by a hundredth.)
    let (lost, predicted) = coasted.split_last().expect("it is predicted");
    assert_eq!((lost.status, lost.state), (TrackStatus::Lost, None));
    let since = |estimate: &TargetEstimate| (estimate.t_valid - cut).s();
    assert!((1.8..2.4).contains(&since(lost)), "lost after {} s", since(lost));
    assert!((0.3..0.7).contains(&since(&predicted[0])), "first after {} s", since(&predicted[0]));
    assert!((11..19).contains(&predicted.len()), "{} predictions", predicted.len());
    let sigma = |e: &TargetEstimate| e.state.and_then(|state| state.relative_sigma_m).expect("reported");
    for pair in predicted.windows(2) {
        assert_eq!(pair[1].status, TrackStatus::Coasting);
        assert!(
            sigma(&pair[1]) > 0.99 * sigma(&pair[0]),
            "{} m after {} m",
            sigma(&pair[1]),
            sigma(&pair[0])
        );
    }
    let (first, last) = (sigma(&predicted[0]), sigma(&predicted[predicted.len() - 1]));
    assert!(last > first, "{last} m after {first} m");
    // Then health and the operator's notices agree.
    let notices = out.iter().filter_map(|timed| match &timed.output {
        Output::Notice(n) if n.t > cut && n.target.is_some() => Some(n.kind),
        _ => None,
    });
    assert_eq!(notices.collect::<Vec<_>>(), [NoticeKind::TargetCoasting, NoticeKind::TargetLost]);
    let healths: Vec<&Health> = out
        .iter()
        .filter_map(|timed| match &timed.output {
            Output::Health(health) if health.t > cut + Span::from_s(0.7) => Some(&**health),
            _ => None,
        })
        .collect();
    for health in healths {
        let (last, since) = (&health.targets[0].last, health.t - cut);
        let expected = if since < Span::from_s(1.8) { TrackStatus::Coasting } else { TrackStatus::Lost };
        assert!(
            last.status == expected || since < Span::from_s(2.4),
            "{:?} after {} s",
            last.status,
            since.s()
        );
        assert!(
            last.state.is_none() || health.t - last.t_valid < Span::from_s(0.2),
            "the figures are current"
        );
    }
}

#[test]
fn the_same_events_coast_the_same() {
    let (config, events, _) = flight_without_frames_after(3.0);
    assert_eq!(coasted(&fly(&config, &events)), coasted(&fly(&config, &events)));
}

#[test]
fn a_camera_that_comes_back_is_used() {
    let (config, _, cut) = flight_without_frames_after(3.0);
    let capture = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures/follow.mcap");
    let back = cut + Span::from_s(1.2);
    let reader = CaptureReader::open(&capture).expect("the capture opens");
    let kept =
        |event: &Event| !(cut..back).contains(&event.t_recv) || !matches!(event.body, EventBody::Frame(_));
    let events: Vec<Event> = reader.filter_map(|item| item.event).filter(kept).collect();
    let out = fly(&config, &events);
    let found = out.iter().find_map(|timed| match &timed.output {
        Output::Estimator(EstimatorOutput::Estimate(e))
            if e.t_valid > cut && e.status == TrackStatus::Tracking =>
        {
            Some(e.t_valid - back)
        }
        _ => None,
    });
    assert!(found.is_some_and(|after| after < Span::from_s(0.5)), "{found:?}");
}
