//! `windhover refine`: a flight afterwards, in its own schemas beside the real-time estimates.

use std::path::Path;

use windhover::app::flight::Flight;
use windhover::io::mcap_read::McapReader;

use crate::contract::{capture, said, scratch, windhover};

fn run(args: &[&str], dir: &Path) -> String {
    let run = windhover(args, dir);
    assert!(run.status.success(), "{args:?}: {}", said(&run));
    String::from_utf8_lossy(&run.stdout).into_owned()
}

#[test]
fn a_refined_flight_stands_beside_the_real_one() {
    // Given a flight.
    let dir = scratch();
    run(&["replay", &capture(), "--out", "flight.mcap"], dir.path());
    // When it is refined.
    let text = run(&["refine", "flight.mcap"], dir.path());
    // Then constants that it determines are printed, and those that it does not.
    assert!(text.contains("constants of the configuration"), "{text}");
    assert!(text.contains("not determined by this flight"), "{text}");
    // What of them differs from the configuration beyond doubt is TOML.
    let adopted = run(&["calibrate", "adopt", "flight.mcap"], dir.path());
    assert!(adopted.parse::<toml::Table>().is_ok(), "{adopted}");
    // And a file beside it has the flight without its pictures, and a refined estimate a frame.
    let (flight, refined) = (
        Flight::read(&dir.path().join("flight.mcap")).expect("a flight"),
        Flight::read(&dir.path().join("flight.refined.mcap")).expect("a refined flight"),
    );
    let [track] = &refined.targets.values().collect::<Vec<_>>()[..] else { panic!("one target") };
    let real_time = flight.targets.values().next().expect("the same target");
    assert_eq!(track.filtered, real_time.filtered);
    let known = |states: &[windhover::io::proto::windhover::TargetState]| -> Vec<u32> {
        states.iter().filter(|state| state.known).map(|state| state.frame).collect()
    };
    assert!(track.paper.len() == real_time.paper.len() && refined.frames.is_empty());
    assert!(known(&track.refined).len() >= known(&track.filtered).len(), "{:?}", known(&track.refined));
    assert!(track.refined.iter().filter(|s| s.known).all(|s| s.covariance.len() == 15));
    assert!(refined.ownship_refined.len() >= track.refined.len());
    let said = refined.refined.as_ref().expect("what it says of the configuration");
    assert!(said.constants.iter().any(|constant| constant.name == "gps_delay"));
    // And the tables have it, in the columns of the estimates.
    run(&["export", "flight.refined.mcap", "--format", "csv", "--out", "tables"], dir.path());
    let head = |name: &str| {
        let text = std::fs::read_to_string(dir.path().join("tables").join(name)).expect("exported");
        (text.lines().next().unwrap_or_default().to_owned(), text.lines().count())
    };
    assert_eq!(head("refined.csv").0, head("estimates.csv").0);
    assert_eq!(head("refined.csv").1, track.refined.len() + 1);
    // The flight itself is read, exported and put into a bag with the refinement beside it.
    assert_eq!((&real_time.refined, flight.refined.as_ref()), (&track.refined, Some(said)));
    run(&["export", "flight.mcap", "--format", "csv", "--out", "of-flight"], dir.path());
    let table = |folder: &str| std::fs::read(dir.path().join(folder).join("refined.csv")).expect("exported");
    assert_eq!(table("of-flight"), table("tables"));
    run(&["export", "flight.mcap", "--format", "rosbag2", "--out", "bag"], dir.path());
    let bag = McapReader::open(&dir.path().join("bag/flight_0.mcap")).expect("a bag");
    let odometry = bag.filter(|message| message.channel.topic == "/ownship/odometry_refined").count();
    assert_eq!(odometry, refined.ownship_refined.len());
    // A refinement that is older than the flight is not used, and that is said.
    let file =
        std::fs::File::options().append(true).open(dir.path().join("flight.mcap")).expect("it is there");
    file.set_modified(std::time::SystemTime::now() + std::time::Duration::from_secs(60)).expect("ours");
    let changed = Flight::read(&dir.path().join("flight.mcap")).expect("a flight");
    assert!(
        changed.refined.is_none() && changed.warnings.iter().any(|w| w.contains("older than the flight"))
    );
    // And refined once more, it is the same flight with one refinement.
    run(&["refine", "flight.refined.mcap", "--out", "again.mcap"], dir.path());
    let again = Flight::read(&dir.path().join("again.mcap")).expect("a refined flight");
    let twice = again.targets.values().next().expect("the target");
    assert_eq!(twice.refined.len(), track.refined.len());
    // And no partial file is left.
    let left = std::fs::read_dir(dir.path()).expect("readable").filter_map(Result::ok);
    assert!(left.into_iter().all(|entry| !entry.file_name().to_string_lossy().ends_with(".part")));
}

#[test]
fn what_is_read_is_never_written_over() {
    let dir = scratch();
    run(&["replay", &capture(), "--out", "flight.mcap"], dir.path());
    let over = windhover(&["refine", "flight.mcap", "--out", "flight.mcap"], dir.path());
    assert_eq!(over.status.code(), Some(2), "{}", said(&over));
}
