//! A daemon that is killed in flight and restarted continues from its saved state.

use std::path::Path;

use rustix::process::Signal;
use windhover::io::mcap_read::{McapReader, RawMessage};
use windhover::io::proto::{host_time, windhover as wh};
use windhover::io::records::topic;
use windhover::io::store::index::{INDEX, Index};
use windhover_base::msg::TagFamily;
use windhover_base::time::Span;
use windhover_detect::tag_pattern;

use super::harness::{Bench, Feeder};

/// Pixels of a cell: a tag of 0.48 m and 8 cells, 3.8 m below a camera of f = 255 px.
const CELL_PX: usize = 4;
/// The tag is 0.55 m over ground at 33 m.
const ALT_MSL_M: f64 = 33.0 + 0.55 + 255.0 * 0.48 / (8 * CELL_PX) as f64;

/// The tag of the bench's vehicle in the middle of the picture.
fn vehicle_below(bench: &Bench) {
    let tag = tag_pattern(TagFamily::Tag36h11, 0);
    let (left, top) = (160 - tag.side() * CELL_PX / 2, 128 - tag.side() * CELL_PX / 2);
    let cell = |at: usize, first: usize| at.checked_sub(first).map(|px| px / CELL_PX);
    bench.draw(|u, v| match (cell(u, left), cell(v, top)) {
        (Some(x), Some(y)) if x < tag.side() && y < tag.side() => 20 + 200 * u8::from(tag.white(x, y)),
        _ => 90,
    });
}

fn messages(flight: &Path) -> Vec<RawMessage> {
    McapReader::open(flight).expect("readable").collect()
}

fn of<M: prost::Message + Default>(messages: &[RawMessage], topic: &str) -> Vec<M> {
    let on_topic = messages.iter().filter(|m| m.channel.topic == topic);
    on_topic.map(|m| M::decode(&m.data[..]).expect("decodes")).collect()
}

#[test]
fn a_restart_in_flight_tracks_within_two_seconds_and_replays() {
    // Given a daemon that tracks the vehicle below and is killed in flight.
    let bench = Bench::new();
    // Frames without loss, so that the replay has the same pixels.
    bench.configure(|text| text.replace("[store]", "[store]\nframes = \"png\""));
    vehicle_below(&bench);
    let (gps, compass) = bench.lines();
    let daemon = bench.start();
    let feeder = Feeder::at_height(gps, compass, ALT_MSL_M);
    let (_, mut seen) = daemon.wait(&["event=target_tracking"]);
    for _ in 0..5 {
        seen = daemon.wait_from(seen, &["event=health"]).1;
    }
    let before = daemon.log().lines().count();
    daemon.kill();

    // When it is started again, then it continues and tracks.
    let daemon = bench.start();
    let (line, seen) = daemon.wait_from(before, &["event=warm_start"]);
    assert!(line.contains("continues from"), "{line}");
    let (_, mut seen) = daemon.wait_from(seen, &["event=target_tracking"]);
    for _ in 0..2 {
        seen = daemon.wait_from(seen, &["event=health"]).1;
    }
    daemon.signal(Signal::TERM);
    assert!(daemon.ended().success());
    feeder.stop();

    // Then, by the daemon's own records, from the first frame to the first tracked state it is not two
    // seconds, and the map has not moved.
    let flights = bench.flights();
    assert_eq!(flights.len(), 2, "{flights:?}");
    let (first, second) = (messages(&flights[0]), messages(&flights[1]));
    let states: Vec<wh::TargetState> = of(&second, &topic::target_state("ugv"));
    let tracked = states.iter().find(|s| s.status == i32::from(wh::TrackStatus::Tracking)).expect("tracks");
    let taken = host_time(tracked.timestamp.as_ref()) - host_time(states[0].timestamp.as_ref());
    assert!(taken < Span::from_s(2.0), "{taken:?} from the first frame to tracking");
    let datums = |flight: &[RawMessage]| -> Vec<[f64; 3]> {
        of::<wh::Datum>(flight, topic::DATUM).iter().map(|d| [d.lat_deg, d.lon_deg, d.height_m]).collect()
    };
    assert_eq!((datums(&first).len(), datums(&first)), (1, datums(&second)));
    let states: Vec<wh::WarmState> = of(&second, topic::WARM_START);
    assert_eq!(states.len(), 1, "the state from which it continued is in the flight");

    // And the state of card and computer is in the flight, and in its report.
    let flight = flights[1].to_string_lossy().into_owned();
    let healths: Vec<wh::Health> = of(&second, topic::HEALTH);
    let health = healths.last().expect("once a second");
    assert!(health.figures["card_free_mb"] > 0.0 && health.figures["mem_mb"] > 0.0, "{:?}", health.figures);
    assert!(health.words.contains_key("card"), "{:?}", health.words);
    bench.command(&["report", &flight, "--out", "report.html"]);
    let page = std::fs::read_to_string(bench.path("report.html")).expect("the report");
    assert!(page.contains("card free mb") && page.contains("card sync p99 ms"), "card and link are reported");

    // When the second flight is replayed, then the same is estimated.
    bench.command(&["replay", &flight, "--out", "again.mcap"]);
    let again = messages(&bench.path("again.mcap"));
    let rows = |flight: &[RawMessage]| -> Vec<wh::TargetState> { of(flight, &topic::target_state("ugv")) };
    let (flown, replayed) = (rows(&second), rows(&again));
    assert!(flown.len() > 10, "{}", flown.len());
    for (flown, replayed) in flown.iter().zip(&replayed) {
        assert_eq!(flown, replayed);
    }
}

#[test]
fn a_card_without_a_known_state_is_reported_and_not_waited_for() {
    // Given a card whose index another program holds.
    let bench = Bench::new();
    let held = Index::open(&bench.path("card").join(INDEX)).expect("a new index");
    let (gps, compass) = bench.lines();
    let feeder = Feeder::start(gps, compass);
    // Then the daemon reports that, and continues.
    let daemon = bench.start();
    let (line, seen) = daemon.wait(&["event=warm_start"]);
    assert!(line.contains("without an earlier state"), "{line}");
    daemon.wait_from(seen, &["event=ready"]);
    // And when the index is free, it is used.
    drop(held);
    daemon.wait_from(seen, &["event=index_ready"]);
    feeder.stop();
}
