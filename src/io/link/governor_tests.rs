//! The search for a path's rate, on simulated paths.

use super::*;

fn at(start: Instant, ms: u64) -> Instant {
    start + Duration::from_millis(ms)
}

/// Acknowledgements of packets of 240 bytes: acknowledged and lost bytes, least round-trip time.
fn noted(acked: u64, lost: u64, rtt: Duration) -> Noted {
    let mut noted = Noted { lost, ..Noted::default() };
    if acked > 0 {
        noted.acknowledge(240, rtt);
    }
    Noted { acked, ..noted }
}

/// A path with a queue: `capacity` bytes a second, `rtt` without queue. Returns the found rate and the greatest
/// standing delay after the first five seconds.
fn run(capacity: f64, rtt_ms: f64, seconds: u64, start: Instant) -> (f64, f64) {
    let mut governor = Governor::new(0.0, start);
    let (mut queued, mut worst) = (0.0_f64, 0.0_f64);
    for tick in 1..=seconds * 10 {
        let now = at(start, tick * 100);
        // Everything that the bucket allows is sent, in messages of 240 bytes.
        let mut offered = 0.0_f64;
        while governor.delay(Priority::Low, now).is_zero() && offered < 1e6 {
            governor.charge(240.0);
            offered += 240.0;
        }
        let rate = governor.rate();
        let offered = offered.max(rate * 0.1);
        let served = (queued + offered).min(capacity * 0.1);
        queued += offered - served;
        let delay_ms = queued / capacity * 1e3;
        if tick > 50 {
            worst = worst.max(delay_ms);
        }
        let rtt = Duration::from_secs_f64((rtt_ms + delay_ms) * 1e-3);
        governor.update(noted(served as u64, 0, rtt), now);
    }
    (governor.rate(), worst)
}

#[test]
fn the_governor_finds_slow_and_fast_paths() {
    let start = Instant::now();
    let (rate, worst) = run(6_000.0, 20.0, 60, start);
    assert!((3_500.0..9_000.0).contains(&rate), "{rate} bytes/s on a path of 6000");
    assert!(worst < 130.0, "{worst} ms of standing delay");
    let (rate, _) = run(1e6, 20.0, 60, start);
    assert!(rate > 4e5, "{rate} bytes/s on a path of 1e6");
}

#[test]
fn a_third_of_the_packets_lost_does_not_throttle_a_path() {
    use rand::{Rng as _, SeedableRng as _};
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    let start = Instant::now();
    let mut governor = Governor::new(0.0, start);
    let rtt = Duration::from_millis(5);
    let mut early = 0.0;
    for tick in 1..=600 {
        let now = at(start, tick * 100);
        let (mut acked, mut lost) = (0, 0);
        // As many messages of 240 bytes as the rate allows in a tenth of a second: one or a few.
        for _ in 0..(governor.rate() * 0.1 / 240.0).ceil() as u64 {
            governor.charge(240.0);
            let fate = if random.random_bool(0.3) { &mut lost } else { &mut acked };
            *fate += 240;
        }
        assert!(!governor.delay(Priority::Low, now).is_zero(), "the rate is the limit");
        governor.update(noted(acked, lost, rtt), now);
        early = if tick == 50 { governor.rate() } else { early };
    }
    assert!(early > RATE_AT_START, "{early} bytes/s after 5 s");
    assert!(governor.rate() > 2.0 * RATE_AT_START, "{} bytes/s after a minute", governor.rate());
}

#[test]
fn what_a_cut_lost_does_not_slow_the_path_down_after_it() {
    let start = Instant::now();
    let mut governor = Governor::new(0.0, start);
    let up = noted(1_000, 0, Duration::from_millis(40));
    // Given: one second of traffic, six of silence.
    for tick in 1..=10 {
        governor.update(up, at(start, tick * 100));
    }
    for tick in 11..=70 {
        governor.update(Noted::default(), at(start, tick * 100));
    }
    let before = governor.rate();
    // When: the first acknowledgement declares everything sent meanwhile lost, the next some more.
    for (tick, lost) in [(71, 45_000), (72, 2_000), (73, 0), (74, 0)] {
        governor.charge(10.0 * before);
        assert!(!governor.delay(Priority::Low, at(start, tick * 100)).is_zero(), "the rate is the limit");
        governor.update(Noted { lost, ..up }, at(start, tick * 100));
    }
    // Then: the rate grows at once.
    assert!(governor.rate() > 1.2 * before, "{} after {before} bytes/s", governor.rate());
}

#[test]
fn a_late_acknowledgement_is_a_queue_only_where_none_are_lost() {
    let start = Instant::now();
    for (lost, slowed) in [(0, true), (200, false)] {
        let mut governor = Governor::new(0.0, start);
        let rate = governor.rate();
        for tick in 1..=30 {
            // Every tenth update sees only one packet, acknowledged 60 ms late.
            let late = if tick % 10 == 0 { 60 } else { 0 };
            governor.update(noted(800, lost, Duration::from_millis(40 + late)), at(start, tick * 100));
        }
        assert_eq!(governor.rate() < rate, slowed, "{} bytes/s with {lost} lost a look", governor.rate());
    }
}

#[test]
fn silence_is_a_cut_and_an_acknowledgement_ends_it() {
    let start = Instant::now();
    let mut governor = Governor::new(0.0, start);
    for tick in 1..20 {
        governor.update(Noted::default(), at(start, tick * 100));
    }
    assert!(governor.is_cut());
    governor.update(noted(100, 0, Duration::from_millis(10)), at(start, 2_000));
    assert!(!governor.is_cut() && governor.rate() >= RATE_LEAST);
}

/// A line of `capacity` bytes a second and 20 ms each way: thirty records a second of 241 bytes, of which the newest
/// replaces a waiting one, and seven of 90 bytes. Returns how many of the former arrived in each second, and their
/// delay beyond the line's own time, ms.
fn line(capacity: f64, seconds: u64, start: Instant) -> (Vec<u64>, Vec<f64>) {
    let mut governor = Governor::new(0.0, start);
    let (mut free_ms, mut waits) = (0.0_f64, None);
    let mut flying: Vec<(f64, u64, u64)> = Vec::new();
    let (mut arrived, mut late) = (vec![0; seconds as usize], Vec::new());
    let mut look = Noted::default();
    for ms in 0..seconds * 1_000 {
        let (now, clock) = (at(start, ms), ms as f64);
        if ms % 1_000 * 30 % 1_000 < 30 {
            waits = Some(ms);
        }
        let live = waits.filter(|_| governor.delay(Priority::Live, now).is_zero());
        for (born, bytes) in
            [live.map(|born| (born, 241)), (ms % 150 == 20).then_some((ms, 90))].into_iter().flatten()
        {
            governor.charge(bytes as f64);
            free_ms = free_ms.max(clock) + bytes as f64 / capacity * 1e3;
            flying.push((free_ms + 40.0, ms, bytes));
            if bytes == 241 {
                waits = None;
                arrived[((free_ms + 20.0) as usize / 1_000).min(seconds as usize - 1)] += 1;
                late.push(free_ms - born as f64);
            }
        }
        flying.retain(|(back, sent, bytes)| {
            if *back <= clock {
                look.acknowledge(*bytes, Duration::from_millis(ms - sent));
            }
            *back > clock
        });
        if ms % 100 == 99 {
            governor.update(std::mem::take(&mut look), now);
        }
    }
    (arrived, late)
}

#[test]
fn a_slow_line_is_filled_and_no_queue_stands_in_it() {
    // Given: lines that carry 6000 and 3000 of the 7830 bytes that come a second: 22 and 9 records fit.
    for (capacity, least, most_late) in [(6_000.0, 20.0, 140.0), (3_000.0, 6.0, 600.0)] {
        let (arrived, mut late) = line(capacity, 60, Instant::now());
        let settled = arrived[5..].iter().sum::<u64>() as f64 / 55.0;
        assert!(settled > least, "{settled} records a second on {capacity} bytes/s: {arrived:?}");
        late.sort_by(f64::total_cmp);
        let p99 = late[late.len() * 99 / 100];
        assert!(p99 < most_late, "{p99} ms late on {capacity} bytes/s; median {}", late[late.len() / 2]);
    }
    // On a line with more capacity everything arrives.
    let (arrived, late) = line(60_000.0, 20, Instant::now());
    assert!(arrived[2..19].iter().all(|n| *n >= 29), "records a second: {arrived:?}");
    assert!(late.iter().filter(|ms| **ms > 10.0).count() <= 5, "late at the start");
}

#[test]
fn a_long_packet_takes_a_slow_line_longer_and_is_no_queue() {
    let start = Instant::now();
    let mut delays = Delays::new(start);
    let mut look = |packets: &[(u64, u64)], ms: u64| {
        let mut noted = Noted::default();
        for (bytes, rtt) in packets {
            noted.acknowledge(*bytes, Duration::from_millis(*rtt));
        }
        delays.look(&noted.least_rtt, false, at(start, ms)).map(|queue| queue.as_millis())
    };
    assert_eq!(look(&[(80, 54)], 100), None, "nothing to compare with");
    assert_eq!(look(&[(240, 81)], 200), None, "the first of its size");
    assert_eq!(look(&[(240, 81), (80, 90)], 300), Some(0));
    assert_eq!(look(&[(240, 121), (80, 94)], 400), Some(40));
    assert_eq!(look(&[(80, 94), (1_100, 400)], 500), Some(40), "a new size hides no queue");
    // A quick long packet is an upper bound for a short one.
    assert_eq!(look(&[(1_100, 50)], 600), Some(0));
    assert_eq!(look(&[(80, 60)], 700), Some(10));
}
