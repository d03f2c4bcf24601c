//! Bursts as receivers send them, and the expected epochs.

use proptest::prelude::*;

use super::gnss::{GnssDecoder, ReceivedEpoch};
use super::sentence::framed;
use super::{DecodeCounts, Refusal};
use windhover_base::msg::FixKind;
use windhover_base::time::{MonoTime, Span};

/// One line on the wire.
fn line(body: &str) -> String {
    framed(body) + "\r\n"
}

fn rmc(time: &str, lat: &str) -> String {
    line(&format!("GPRMC,{time},A,{lat},N,08530.00000,W,010.0,090.0,010226,003.4,W,D"))
}

fn gga(time: &str, lat: &str, alt: &str) -> String {
    line(&format!("GPGGA,{time},{lat},N,08530.00000,W,2,09,0.9,{alt},M,-27.0,M,,"))
}

fn gll(time: &str, lat: &str) -> String {
    line(&format!("GPGLL,{lat},N,08530.00000,W,{time},A"))
}

/// A Garmin burst: RMC, GGA, GSA, PGRME, PGRMV with the second's number in altitude, error, speed.
fn garmin(second: u32) -> String {
    let (time, value) = (format!("1011{second:02}"), format!("{second}.5"));
    rmc(&time, "3030.00000")
        + &gga(&time, "3030.00000", &value)
        + &line("GPGSA,A,3,02,04,05,09,,,,,,,,,1.6,0.9,1.3")
        + &line(&format!("PGRME,{value},M,4.1,M,4.9,M"))
        + &line(&format!("PGRMV,{value},-1.0,0.5"))
}

fn decode(mut decoder: GnssDecoder, text: &str) -> (Vec<ReceivedEpoch>, DecodeCounts) {
    let mut out = Vec::new();
    decoder.push(text.as_bytes(), MonoTime::default(), &mut out);
    decoder.flush(&mut out);
    (out, decoder.counts().clone())
}

fn seconds(epochs: &[ReceivedEpoch]) -> Vec<Option<i64>> {
    epochs.iter().map(|e| e.epoch.time_of_day_ns.map(|ns| ns / 1_000_000_000 % 60)).collect()
}

#[test]
fn an_epoch_holds_its_own_second_only() {
    let text: String = (1..=6).map(garmin).collect();
    for decoder in [GnssDecoder::new(), GnssDecoder::patient()] {
        let (epochs, counts) = decode(decoder, &text);
        assert_eq!(epochs.len(), 6, "{counts}");
        for (index, received) in epochs.iter().enumerate() {
            let (epoch, value) = (received.epoch, index as f64 + 1.5);
            assert_eq!(
                (epoch.fix, epoch.alt_msl_m, epoch.hpe_m),
                (FixKind::ThreeD, Some(value), Some(value))
            );
            let velocity = epoch.vel_ned_mps.expect("PGRMV has it");
            assert_eq!((velocity.x, velocity.y, velocity.z), (-1.0, value, -0.5));
            assert!(epoch.vel_has_down && received.opens_burst);
        }
        assert_eq!(epochs[0].epoch.utc.expect("dated").to_string(), "2026-02-01T10:11:01.000Z");
    }
}

#[test]
fn the_last_sentence_of_a_known_cycle_gives_the_epoch_out() {
    // Given a receiver whose bursts were seen to end with PGRMV
    let (mut decoder, mut out) = (GnssDecoder::new(), Vec::new());
    for second in 1..=4 {
        decoder.push(garmin(second).as_bytes(), MonoTime::from_ns(i64::from(second) * 200_000_000), &mut out);
    }
    // When the fifth burst is complete, or lacks a sentence before the last
    out.clear();
    decoder.push(garmin(5).as_bytes(), MonoTime::from_ns(1_000_000_000), &mut out);
    // Then its epoch is output with it
    assert_eq!(seconds(&out), [Some(5)]);
    let damaged = garmin(6).replace("$GPGGA", "$GPGGB");
    decoder.push(damaged.as_bytes(), MonoTime::from_ns(1_200_000_000), &mut out);
    assert_eq!(seconds(&out), [Some(5), Some(6)]);
    assert_eq!(out[1].epoch.alt_msl_m, None);
    assert_eq!(decoder.counts().refused(Refusal::BadChecksum), 1);
}

#[test]
fn silence_gives_an_open_epoch_out() {
    let (mut decoder, mut out) = (GnssDecoder::new(), Vec::new());
    decoder.push(garmin(1).as_bytes(), MonoTime::default(), &mut out);
    decoder.tick(MonoTime::default() + Span::from_ms(100.0), &mut out);
    assert!(out.is_empty());
    decoder.tick(MonoTime::default() + Span::from_ms(301.0), &mut out);
    assert_eq!(seconds(&out), [Some(1)]);
}

#[test]
fn a_gll_of_the_next_second_stays_apart() {
    // Given the order of an old Garmin, in which the GLL in the burst of one second has the time of the next
    let burst = |second: u32| {
        let time = format!("2253{second:02}");
        rmc(&time, "3030.00000")
            + &gga(&time, "3030.00000", "14.7")
            + &line("GPGSA,A,3,01,,,,13,20,22,,,,28,,3.1,2.1,2.0")
            + &gll(&format!("2253{:02}", second + 1), "3031.00000")
            + &line("PGRME,9.1,M,15.0,M,12.0,M")
    };
    let text: String = (0..4).map(|n| burst(8 + 2 * n)).collect();
    let (epochs, counts) = decode(GnssDecoder::new(), &text);
    // Then each is a separate epoch and the errors belong to the burst, not to the GLL
    assert_eq!(seconds(&epochs), [8, 9, 10, 11, 12, 13, 14, 15].map(Some), "{counts}");
    for pair in epochs.chunks(2) {
        let (main, gll) = (&pair[0], &pair[1]);
        assert_eq!((main.epoch.lat_deg, main.epoch.hpe_m), (Some(30.5), Some(9.1)));
        assert!((gll.epoch.lat_deg.expect("given") - (30.0 + 31.0 / 60.0)).abs() < 1e-12);
        assert_eq!((gll.epoch.alt_msl_m, gll.epoch.hpe_m), (None, None));
        assert!(main.opens_burst && !gll.opens_burst);
    }
}

#[test]
fn a_cycle_that_begins_with_gll_is_one_epoch() {
    let burst = |second: u32| {
        let time = format!("2253{second:02}");
        gll(&time, "3030.00000") + &gga(&time, "3030.00000", "14.7") + &rmc(&time, "3030.00000")
    };
    let text: String = (1..=6).map(burst).collect();
    let (epochs, counts) = decode(GnssDecoder::new(), &text);
    assert_eq!(seconds(&epochs), [1, 2, 3, 4, 5, 6].map(Some), "{counts}");
    assert!(epochs.iter().all(|received| received.opens_burst && received.epoch.alt_msl_m == Some(14.7)));
}

#[test]
fn what_lost_its_time_goes_to_no_epoch() {
    // Given a burst whose RMC and GGA were damaged
    let text = garmin(1) + &garmin(2).replace("GPRMC", "GPRMX").replace("GPGGA", "GPGGX") + &garmin(3);
    let (epochs, counts) = decode(GnssDecoder::new(), &text);
    // Then its errors and velocity belong neither to the second before nor to the one after
    assert_eq!(seconds(&epochs), [Some(1), Some(3)]);
    assert_eq!((epochs[0].epoch.hpe_m, epochs[1].epoch.hpe_m), (Some(1.5), Some(3.5)));
    assert_eq!(counts.refused(Refusal::NoTime), 3);
}

#[test]
fn midnight_leap_second_and_missing_date() {
    let undated = |time: &str| gga(time, "3030.00000", "10.0");
    let eve = line("GPRMC,235959.5,A,3030.00000,N,08530.00000,W,0.0,,311216,,,A");
    let text = undated("235958.5")
        + &eve
        + &undated("235959.5")
        + &undated("235960.0")
        + &undated("235960.5")
        + &undated("000000.0");
    let (epochs, _) = decode(GnssDecoder::patient(), &text);
    let utc: Vec<String> =
        epochs.iter().map(|e| e.epoch.utc.map_or_else(|| "none".to_owned(), |utc| utc.to_string())).collect();
    let day = "2017-01-01T00:00:00";
    let expected = [
        "none".to_owned(),
        "2016-12-31T23:59:59.500Z".to_owned(),
        format!("{day}.000Z"),
        format!("{day}.500Z"),
        format!("{day}.000Z"),
    ];
    assert_eq!(utc, expected);
    assert_eq!(epochs[2].epoch.time_of_day_ns, Some(86_400_000_000_000));
}

fn zda(time: &str) -> String {
    line(&format!("GPZDA,{time},01,02,2026,00,00"))
}

/// Pushes each line of the text at its time, bursts 1 s apart, lines 20 ms, and ticks between them.
fn live(bursts: &[String]) -> (Vec<ReceivedEpoch>, DecodeCounts) {
    let (mut decoder, mut out) = (GnssDecoder::new(), Vec::new());
    for (second, burst) in bursts.iter().enumerate() {
        let begin = MonoTime::from_ns(HOST_NS) + Span::from_s(second as f64);
        let lines: Vec<&str> = burst.split_inclusive('\n').collect();
        for (index, line) in lines.iter().enumerate() {
            decoder.push(line.as_bytes(), begin + Span::from_ms(20.0 * index as f64), &mut out);
        }
        for tick in 1..10 {
            decoder.tick(begin + Span::from_ms(100.0 * f64::from(tick)), &mut out);
        }
    }
    decoder.flush(&mut out);
    (out, decoder.counts().clone())
}

/// 2026-02-01T10:11:00Z.
const HOST_NS: i64 = 1_769_940_660_000_000_000;

/// The order of sentences in a burst, and whether its ZDA is of the same second, of later ones, or leads.
fn dated(second: u32, ahead: i64, leads: bool) -> String {
    let time = format!("1011{second:02}");
    let reported = format!("1011{:02}", i64::from(second) + ahead);
    let fix = gga(&time, "3030.00000", "43.0") + &line("GPGSA,A,3,02,04,05,09,,,,,,,,,1.6,0.9,1.3");
    if leads { zda(&reported) + &fix } else { fix + &zda(&reported) }
}

#[test]
fn a_zda_dates_and_never_opens_an_epoch() {
    for (ahead, leads) in [(0, false), (0, true), (2, false), (2, true), (-1, false), (-3, true), (1, false)]
    {
        let bursts: Vec<String> = (10..30).map(|second| dated(second, ahead, leads)).collect();
        let ways = [live(&bursts), decode(GnssDecoder::patient(), &bursts.concat())];
        for (which, (epochs, counts)) in ways.iter().enumerate() {
            let what = format!("ahead {ahead}, leads {leads}, way {which}: {counts}");
            assert_eq!((epochs.len(), counts.refused_total()), (20, 0), "{what}");
            assert!(epochs.iter().all(|received| received.epoch.fix == FixKind::ThreeD), "{what}");
            assert!(epochs.iter().all(|received| received.epoch.hdop == Some(0.9)), "{what}");
            let dated = epochs.iter().skip(2).enumerate();
            for (index, received) in dated {
                let utc = received.epoch.utc.map(|utc| utc.to_string());
                assert_eq!(utc, Some(format!("2026-02-01T10:11:{}.000Z", index + 12)), "{what}");
            }
        }
        // Its burst begins with the ZDA only where the ZDA leads it.
        let begins =
            |received: &ReceivedEpoch| (received.t_first_byte.ns() - HOST_NS) % 1_000_000_000 / 1_000_000;
        let late = if leads && ahead != 0 { 20 } else { 0 };
        let settled = live(&bursts).0;
        assert!(
            settled[5..].iter().all(|received| begins(received) == late || begins(received) == 0),
            "ahead {ahead}"
        );
        if ahead == 0 || !leads {
            // Before the first burst it is not known to which burst its first sentence belongs.
            assert!(
                settled[1..].iter().all(|received| begins(received) == 0),
                "ahead {ahead}, leads {leads}"
            );
        }
    }
}

#[test]
fn a_date_without_a_fix_is_none() {
    let cold = |date: &str| {
        line(&format!("GPRMC,235955.800,V,,,,,0.00,0.00,{date},,,N"))
            + &line("GPGGA,235955.800,,,,,0,00,,,M,,M,,")
            + &line("GPZDA,235955.800,06,01,1980,,")
    };
    for date in ["050180", "060180", "220899", "181126"] {
        let text = cold(date);
        for (epochs, _) in [live(std::slice::from_ref(&text)), decode(GnssDecoder::patient(), &text)] {
            assert!(
                !epochs.is_empty() && epochs.iter().all(|received| received.epoch.utc.is_none()),
                "{date}"
            );
        }
    }
    // The date comes with the fix, and the zeros before it are dropped.
    let bursts = [cold("060180"), cold("060180"), garmin(20), garmin(21)];
    let (epochs, _) = live(&bursts);
    let utc: Vec<_> = epochs.iter().map(|received| received.epoch.utc.map(|utc| utc.to_string())).collect();
    assert_eq!(
        utc[utc.len() - 2..],
        ["2026-02-01T10:11:20.000Z", "2026-02-01T10:11:21.000Z"].map(|t| Some(t.into()))
    );
}

#[test]
fn a_second_reported_twice_is_two_epochs() {
    let bursts: Vec<String> = [10, 11, 12, 13, 14, 14, 15, 16].map(garmin).to_vec();
    let (epochs, counts) = live(&bursts);
    assert_eq!(seconds(&epochs), [10, 11, 12, 13, 14, 14, 15, 16].map(Some), "{counts}");
}

#[test]
fn a_receiver_without_time_or_fix_is_decoded() {
    let burst =
        line("GPRMC,,V,,,,,,,260810,1.0,E,N") + &line("GPGGA,,,,,,0,00,,,M,,M,,") + &line("PGRME,,M,,M,,M");
    let (epochs, _) = decode(GnssDecoder::new(), &burst.repeat(5));
    assert_eq!(epochs.len(), 5);
    assert!(
        epochs.iter().all(|received| received.epoch.fix == FixKind::None && received.epoch.utc.is_none())
    );
}

#[test]
fn a_receiver_of_rmc_and_gns_alone_has_altitude() {
    let burst = |second: u32| {
        line(&format!("GNGNS,1200{second:02}.00,3842.20000,N,00911.00000,W,RRRR,14,0.6,50.1,48.0,1.0,0000,V"))
            + &line(&format!("GNRMC,1200{second:02}.00,A,3842.20000,N,00911.00000,W,0.1,,181126,,,R,V"))
    };
    let text: String = (0..5).map(burst).collect();
    let (epochs, counts) = decode(GnssDecoder::new(), &text);
    assert_eq!((epochs.len(), counts.refused_total()), (5, 0), "{counts}");
    for received in epochs {
        let epoch = received.epoch;
        assert_eq!((epoch.fix, epoch.alt_msl_m, epoch.sats), (FixKind::RtkFixed, Some(50.1), Some(14)));
    }
}

#[test]
fn what_is_left_out_is_counted_by_name() {
    let odd = line("GPRMC,101101,A,3030.00000,N,08530.00000,W,010.0,090.0,010226,999.9000,E,D");
    let (epochs, counts) = decode(GnssDecoder::patient(), &odd.repeat(3));
    assert_eq!(counts.left_out().collect::<Vec<_>>(), [("RMC magnetic variation", 3)]);
    assert!(counts.to_string().contains("3 without RMC magnetic variation"), "{counts}");
    let epoch = epochs[0].epoch;
    assert!(epoch.utc.is_some() && epoch.vel_ned_mps.is_some() && counts.refused_total() == 0);
}

#[test]
fn a_void_sentence_voids_its_epoch() {
    let void = line("GPRMC,101101,V,3030.00000,N,08530.00000,W,010.0,090.0,010226,003.4,W,N");
    let text = gga("101101", "3030.00000", "10.0") + &void;
    let (epochs, counts) = decode(GnssDecoder::patient(), &text);
    assert_eq!(epochs.len(), 1, "{counts}");
    assert_eq!(
        (epochs[0].epoch.fix, epochs[0].epoch.lat_deg, epochs[0].epoch.sats),
        (FixKind::None, None, Some(9))
    );
}

#[test]
fn a_fix_of_no_satellites_needs_another_witness() {
    let empty = line("GPGGA,101101,3030.00000,N,08530.00000,W,1,00,3.3,10.0,M,-27.0,M,,");
    let fix = |text: &str| decode(GnssDecoder::patient(), text).0[0].epoch.fix;
    assert_eq!(fix(&empty), FixKind::None);
    assert_eq!(fix(&(rmc("101101", "3030.00000") + &empty)), FixKind::ThreeD);
}

#[test]
fn rtk_is_found_by_quality_or_modes() {
    let gga = |quality: u32| {
        line(&format!("GNGGA,101101,3030.00000,N,08530.00000,W,{quality},19,0.5,10.0,M,-27.0,M,1.0,0001"))
    };
    let rmc = |mode: &str| {
        line(&format!("GNRMC,101101,A,3030.00000,N,08530.00000,W,010.0,090.0,010226,,,{mode},V"))
    };
    let gns =
        |modes: &str| line(&format!("GNGNS,101101,3030.0,N,08530.0,W,{modes},14,0.6,50.1,48.0,1.0,0000,V"));
    let gsa = |fix: u32| line(&format!("GNGSA,A,{fix},01,02,03,04,,,,,,,,,1.6,0.9,1.3"));
    let fix = |text: &str| decode(GnssDecoder::patient(), text).0[0].epoch.fix;
    for (text, kind) in [
        (gga(1), FixKind::ThreeD),
        (gga(2), FixKind::ThreeD),
        (gga(4), FixKind::RtkFixed),
        (gga(5), FixKind::RtkFloat),
        (gga(4) + &gsa(3), FixKind::RtkFixed),
        (gga(5) + &gsa(2), FixKind::TwoD),
        (gns("RRNR"), FixKind::RtkFixed),
        (gns("RF"), FixKind::RtkFloat),
        (gns("RA"), FixKind::ThreeD),
        // GGA takes precedence over the others in any order.
        (rmc("R") + &gga(5), FixKind::RtkFloat),
        (gga(4) + &rmc("A"), FixKind::RtkFixed),
        (gns("FF") + &rmc("R"), FixKind::RtkFloat),
        (gga(0) + &rmc("R"), FixKind::None),
    ] {
        assert_eq!(fix(&text), kind, "{text}");
    }
}

#[test]
fn velocity_without_garmin_is_of_speed_and_course() {
    let (epochs, _) = decode(GnssDecoder::patient(), &rmc("101101", "3030.00000"));
    let velocity = epochs[0].epoch.vel_ned_mps.expect("speed and course are given");
    assert!(velocity.x.abs() < 1e-9 && (velocity.y - 5.144_444).abs() < 1e-5 && velocity.z == 0.0);
    assert!(!epochs[0].epoch.vel_has_down);
    let slow = line("GPRMC,101101,A,3030.00000,N,08530.00000,W,0.048,,010226,,,A");
    let (epochs, _) = decode(GnssDecoder::patient(), &slow);
    assert_eq!(epochs[0].epoch.vel_ned_mps, None, "a speed without a direction");
}

proptest! {
    #[test]
    fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..4_000)) {
        let (mut decoder, mut out) = (GnssDecoder::new(), Vec::new());
        decoder.push(&bytes, MonoTime::default(), &mut out);
        decoder.flush(&mut out);
        prop_assert!(out.is_empty(), "noise is not a fix");
    }

    #[test]
    fn sound_frames_of_any_fields_are_survived(
        bodies in prop::collection::vec(
            "(GP(RMC|GGA|GLL|GSA|VTG|ZDA|GNS)|PGRM(E|V|F))(,[-.0-9A-Z]{0,7}){0,18}", 0..40),
    ) {
        let text: String = bodies.iter().map(|body| line(body)).collect();
        let (epochs, _) = decode(GnssDecoder::new(), &text);
        for received in epochs {
            let epoch = received.epoch;
            prop_assert!(epoch.lat_deg.is_none_or(|lat| (-90.0..=90.0).contains(&lat)));
            prop_assert!(epoch.lon_deg.is_none_or(|lon| (-180.0..=180.0).contains(&lon)));
            prop_assert!(epoch.alt_msl_m.is_none_or(f64::is_finite));
        }
    }

    #[test]
    fn where_reads_cut_the_stream_changes_nothing(
        cuts in prop::collection::vec(1usize..40, 1..60),
        damage in prop::collection::vec((0usize..1_500, any::<u8>()), 0..6),
    ) {
        let mut bytes: Vec<u8> = (1..=6).flat_map(|second| garmin(second).into_bytes()).collect();
        for (at, byte) in damage {
            let at = at % bytes.len();
            bytes[at] = byte;
        }
        let (mut whole, mut at_once) = (GnssDecoder::new(), Vec::new());
        whole.push(&bytes, MonoTime::default(), &mut at_once);
        let (mut cut, mut in_pieces) = (GnssDecoder::new(), Vec::new());
        let (mut rest, mut sizes) = (&bytes[..], cuts.iter().cycle());
        while !rest.is_empty() {
            let (read, after) = rest.split_at((*sizes.next().expect("endless")).min(rest.len()));
            cut.push(read, MonoTime::default(), &mut in_pieces);
            rest = after;
        }
        let epochs = |received: &[ReceivedEpoch]| received.iter().map(|h| h.epoch).collect::<Vec<_>>();
        prop_assert_eq!(epochs(&at_once), epochs(&in_pieces));
        prop_assert_eq!(whole.counts(), cut.counts());
    }
}
