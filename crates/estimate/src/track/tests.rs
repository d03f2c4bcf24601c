//! A track's life, transition by transition.

use super::*;

const FIRST: Sighting = Sighting { t: MonoTime::from_ns(5), place: [1.0, 2.0] };
const NONE: Evidence = Evidence { refused: 0, unconfirmed: false };
const PLACED: Evidence = Evidence { refused: 0, unconfirmed: true };

fn away(away_s: f64) -> Circumstances {
    let lost_after = Some(Span::from_s(30.0));
    Circumstances { away: Span::from_s(away_s), lost_after, heading_doubtful: false }
}

fn fixed(away_s: f64) -> Circumstances {
    Circumstances { lost_after: None, ..away(away_s) }
}

fn acquiring(frames: u32, evidence: Evidence) -> Life {
    Life::Acquiring { frames, evidence, missing: false }
}

fn refused(times: u32) -> Evidence {
    Evidence { refused: times, unconfirmed: false }
}

#[test]
fn a_target_never_seen_stays_unknown_until_it_is() {
    assert_eq!(Life::Unknown.unseen(&away(1e6)), Life::Unknown);
    assert_eq!(Life::Unknown.on_sight(&away(0.0)), OnSight::Start);
    assert_eq!(Life::Unknown.status(), TrackStatus::Lost);
    assert!(!Life::Unknown.is_held());
}

#[test]
fn six_frames_start_it_two_more_and_certainty_make_it_tracked() {
    let mut life = Life::started(FIRST);
    for frames in 2..FRAMES_TO_START {
        assert_eq!(life.settled(Certainty::Settled), life, "a start is not believed");
        assert_eq!(life.on_sight(&away(0.1)), OnSight::StartAgain(FIRST));
        life = life.started_again(FIRST);
        assert_eq!(life, Life::Started { frames, first: FIRST, missing: false });
    }
    life = life.started_again(FIRST);
    assert_eq!(life, acquiring(FRAMES_TO_START, NONE));
    assert_eq!(life.on_sight(&away(0.1)), OnSight::Fuse);
    life = life.accepted().settled(Certainty::Settled);
    assert_eq!(life, acquiring(FRAMES_TO_TRACK - 1, NONE));
    life = life.accepted();
    assert_eq!(life.settled(Certainty::Between), acquiring(FRAMES_TO_TRACK, NONE));
    assert_eq!(life.settled(Certainty::Settled), Life::Tracking(NONE));
}

#[test]
fn one_not_believed_is_missing_after_a_second_and_takes_up_where_it_was() {
    for life in [Life::started(FIRST), acquiring(7, NONE)] {
        assert_eq!(life.status(), TrackStatus::Acquiring);
        assert_eq!(life.unseen(&away(0.9)), life);
        let missing = life.unseen(&away(1.1));
        assert_eq!(missing.status(), TrackStatus::Lost);
        assert_eq!(missing.unseen(&away(2.0)), missing);
        assert_eq!(missing.settled(Certainty::Between), life);
        assert_eq!(missing.unseen(&away(31.0)), Life::Lost);
    }
    let missing = acquiring(7, NONE).unseen(&away(1.1));
    let doubtful = Circumstances { heading_doubtful: true, ..away(1.2) };
    assert_eq!(missing.on_sight(&doubtful), OnSight::PlaceAnew);
    assert_eq!(acquiring(7, NONE).on_sight(&doubtful), OnSight::Fuse);
}

#[test]
fn a_tracked_one_coasts_out_of_sight_and_is_lost_after_its_time() {
    let tracking = Life::Tracking(refused(1));
    assert_eq!(tracking.unseen(&away(0.1)), tracking);
    let coasting = tracking.unseen(&away(0.2));
    assert_eq!(coasting, Life::Coasting(refused(1)));
    assert_eq!(coasting.unseen(&away(29.0)), coasting);
    assert_eq!(coasting.settled(Certainty::Between), coasting, "nothing was accepted yet");
    assert_eq!(coasting.accepted().settled(Certainty::Between), Life::Tracking(NONE));
    assert_eq!(coasting.unseen(&away(31.0)), Life::Lost);
    assert_eq!(tracking.on_sight(&away(31.0)), OnSight::Start, "no frame came in between");
    assert_eq!(Life::Lost.on_sight(&away(31.0)), OnSight::Start);
    assert_eq!(Life::Lost.unseen(&away(32.0)), Life::Lost);
    assert!(Life::Lost.is_held());
}

#[test]
fn what_cannot_move_is_never_lost_nor_placed_anew() {
    let coasting = Life::Tracking(NONE).unseen(&fixed(100.0));
    assert_eq!(coasting, Life::Coasting(NONE));
    assert_eq!(coasting.unseen(&fixed(1e6)), coasting);
    let doubtful = Circumstances { heading_doubtful: true, ..fixed(100.0) };
    assert_eq!(coasting.on_sight(&doubtful), OnSight::Fuse);
    assert_eq!(Life::Coasting(refused(2)).verdict(5, false), Verdict::Start);
}

#[test]
fn one_that_comes_back_with_a_doubtful_heading_is_placed_anew() {
    let back = Circumstances { heading_doubtful: true, ..away(3.0) };
    for life in [Life::Tracking(NONE), Life::Coasting(NONE)] {
        assert_eq!(life.on_sight(&back), OnSight::PlaceAnew);
    }
    let sure = Circumstances { heading_doubtful: false, ..back };
    assert_eq!(Life::Tracking(NONE).on_sight(&sure), OnSight::Fuse, "no frame came in between");
    assert_eq!(Life::Coasting(NONE).on_sight(&sure), OnSight::Return);
    assert_eq!(
        Life::Tracking(NONE).on_sight(&Circumstances { away: Span::from_s(0.1), ..back }),
        OnSight::Fuse
    );
    let placed = Life::Coasting(refused(1)).placed_anew();
    assert_eq!(placed, Life::Coasting(PLACED));
    assert_eq!(placed.settled(Certainty::Settled).status(), TrackStatus::Coasting);
    assert_eq!(placed.accepted().settled(Certainty::Settled), Life::Tracking(NONE));
}

#[test]
fn a_believed_track_outlives_more_refusals_than_a_doubted_one() {
    let mut life = Life::Tracking(NONE);
    for _ in 0..4 {
        life = life.refused();
        assert_eq!(life.verdict(5, true), Verdict::Keep);
    }
    assert_eq!(life.refused().refusals(), 5);
    assert_eq!(life.refused().verdict(5, true), Verdict::PlaceAnew);
    assert_eq!(life.accepted(), Life::Tracking(NONE));
    assert_eq!(Life::Coasting(refused(1)).verdict(5, true), Verdict::Keep);
    assert_eq!(Life::Coasting(refused(2)).verdict(5, true), Verdict::PlaceAnew);
    assert_eq!(acquiring(8, refused(2)).verdict(5, true), Verdict::Start);
    let missing = Life::Acquiring { frames: 8, evidence: refused(2), missing: true };
    assert_eq!(missing.verdict(5, true), Verdict::PlaceAnew);
}

#[test]
fn a_place_nothing_confirms_starts_the_track_anew() {
    let placed = Life::Tracking(refused(5)).placed_anew();
    assert_eq!(placed, Life::Coasting(PLACED));
    assert_eq!(placed.refused().verdict(5, true), Verdict::Keep);
    assert_eq!(placed.refused().refused().verdict(5, true), Verdict::Start);
    assert_eq!(placed.accepted(), Life::Coasting(NONE));
}

#[test]
fn a_track_in_doubt_is_believed_no_more_until_it_settles() {
    for life in [Life::Tracking(refused(1)), Life::Coasting(refused(1))] {
        let doubted = life.settled(Certainty::Doubtful);
        assert_eq!(doubted, acquiring(BELIEVED_BEFORE, refused(1)));
        assert_eq!(doubted.unseen(&away(5.0)), doubted, "it is not forgotten");
        assert_eq!(doubted.unseen(&away(31.0)), Life::Lost);
        let back = Circumstances { heading_doubtful: true, ..away(5.0) };
        assert_eq!(doubted.on_sight(&back), OnSight::PlaceAnew);
    }
    assert_eq!(acquiring(FRAMES_TO_TRACK, NONE).settled(Certainty::Settled), Life::Tracking(NONE));
    assert_eq!(Certainty::of(0.2, 0.9), Certainty::Settled);
    assert_eq!(Certainty::of(0.2, 1.1), Certainty::Between);
    assert_eq!(Certainty::of(0.2, 2.6), Certainty::Doubtful);
    assert_eq!(Certainty::of(0.9, 0.1), Certainty::Doubtful);
}
