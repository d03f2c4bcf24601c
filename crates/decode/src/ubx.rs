//! u-blox's binary packets (UBX), among sentences or alone.
//!
//! Packet: B5 62, class, identity, u16 length, payload, Fletcher sum over all between; little-endian. The `ublox` crate
//! reads the payloads; only its plain fields are used, because its enums do not cover all values of flags.
//!
//! | packet | used |
//! |---|---|
//! | NAV-PVT | time and date where valid, kind of fix (also: RTK), position, both heights, velocity, accuracies, satellites |
//! | NAV-COV | one-sigma of position and velocity along north, east, down, where valid |
//! | NAV-TIMEUTC, TIM-TP | the date, where UTC is valid |
//! | NAV-RELPOSNED | the heading between two antennas ([`relative_heading`]) |
//!
//! Others are skipped. Source: u-blox's interface descriptions.

use nalgebra::Vector3;
use ublox::UbxProtocol;
use ublox::nav_cov::NavCovRef;
use ublox::nav_pvt::proto31::NavPvtRef;
use ublox::proto31::{PacketRef, Proto31};
use ublox::tim_tp::{TimTpRef, TimTpTimeBase};

use super::counts::{DecodeCounts, Refusal};
use super::lines::LineSpan;
use super::report::{Date, Kind, Report, Solution};
use windhover_base::msg::FixKind;
use windhover_base::time::{MonoTime, NS_PER_S, UtcTime};

/// Marks, class, identity, length.
const HEAD: usize = 6;
/// Bytes around a payload.
const AROUND: usize = HEAD + 2;
/// Longest accepted payload: raw measurements of all satellites.
const PAYLOAD_MAX: usize = 4_096;
/// Existing classes. Two marks before anything else are chance.
const CLASSES: [u8; 15] =
    [0x01, 0x02, 0x04, 0x05, 0x06, 0x09, 0x0A, 0x0B, 0x0D, 0x10, 0x13, 0x21, 0x27, 0x28, 0x29];

/// A piece of a stream.
pub(super) enum Piece<'a> {
    /// Bytes outside packets, and how many bytes of the read follow.
    Outside(&'a [u8], usize),
    /// A complete packet and its place in time.
    Packet(&'a [u8], LineSpan),
}

/// Extracts packets from a stream.
#[derive(Clone, Debug, Default)]
pub(super) struct Splitter {
    packet: Vec<u8>,
    began: MonoTime,
    first_read_bytes: usize,
}

enum Held {
    Whole,
    Begun,
    NoPacket,
    Damaged,
}

impl Splitter {
    /// Takes the bytes of one read, after which `after` more follow, and passes its pieces to `sink`.
    pub(super) fn push(
        &mut self,
        bytes: &[u8],
        after: usize,
        t_recv: MonoTime,
        counts: &mut DecodeCounts,
        sink: &mut impl FnMut(Piece<'_>, &mut DecodeCounts),
    ) {
        let mut rest = bytes;
        while !rest.is_empty() {
            if self.packet.is_empty() {
                let at = rest.iter().position(|byte| *byte == 0xB5).unwrap_or(rest.len());
                let (outside, packet) = rest.split_at(at);
                if !outside.is_empty() {
                    sink(Piece::Outside(outside, packet.len() + after), counts);
                }
                (self.began, self.first_read_bytes) = (t_recv, packet.len() + after);
                self.packet.extend(packet.first());
                rest = packet.get(1..).unwrap_or_default();
                continue;
            }
            self.packet.push(rest[0]);
            rest = &rest[1..];
            match self.held() {
                Held::Begun => {}
                Held::Whole => {
                    let span = LineSpan {
                        t_first: self.began,
                        first_read_bytes: self.first_read_bytes,
                        t_last: t_recv,
                        bytes_after: rest.len() + after,
                        bytes: self.packet.len(),
                    };
                    sink(Piece::Packet(&self.packet, span), counts);
                    self.packet.clear();
                }
                broken => {
                    if matches!(broken, Held::Damaged) {
                        counts.refuse(Refusal::BadChecksum);
                    }
                    // Its mark is noise; the following bytes may be anything.
                    let held = std::mem::take(&mut self.packet);
                    sink(Piece::Outside(&held[..1], held.len() - 1 + rest.len() + after), counts);
                    self.push(&held[1..], rest.len() + after, t_recv, counts, sink);
                }
            }
        }
    }

    fn held(&self) -> Held {
        let packet = &self.packet[..];
        let length = match *packet {
            [_, mark, ..] if mark != 0x62 => return Held::NoPacket,
            [_, _, class, ..] if !CLASSES.contains(&class) => return Held::NoPacket,
            [_, _, _, _, low, high, ..] => usize::from(u16::from_le_bytes([low, high])),
            _ => return Held::Begun,
        };
        if length > PAYLOAD_MAX {
            return Held::NoPacket;
        }
        if packet.len() < length + AROUND {
            return Held::Begun;
        }
        if packet.ends_with(&checksum(&packet[2..packet.len() - 2])) { Held::Whole } else { Held::Damaged }
    }
}

/// Fletcher sum of 8 bits over class, identity, length and payload.
fn checksum(summed: &[u8]) -> [u8; 2] {
    let (a, b) = summed.iter().fold((0u8, 0u8), |(a, b), byte| {
        let a = a.wrapping_add(*byte);
        (a, b.wrapping_add(a))
    });
    [a, b]
}

/// A packet as sent. Payloads have at most 65,535 bytes; the rest of a longer one is left out.
pub fn ubx_framed(class: u8, identity: u8, payload: &[u8]) -> Vec<u8> {
    let length = u16::try_from(payload.len()).unwrap_or(u16::MAX);
    let mut packet = vec![0xB5, 0x62, class, identity];
    packet.extend_from_slice(&length.to_le_bytes());
    packet.extend_from_slice(&payload[..usize::from(length)]);
    let sum = checksum(&packet[2..]);
    packet.extend_from_slice(&sum);
    packet
}

/// Class, identity and payload of each complete packet with a correct checksum.
///
/// ```
/// use windhover_decode::{ubx_framed, ubx_packets};
///
/// // An acknowledgement between other bytes.
/// let bytes = [&b"noise"[..], &ubx_framed(0x05, 0x01, &[0x06, 0x8A]), b"$GP"].concat();
/// let packets: Vec<_> = ubx_packets(&bytes).collect();
/// assert_eq!(packets, [(0x05, 0x01, &[0x06, 0x8A][..])]);
/// ```
pub fn ubx_packets(bytes: &[u8]) -> impl Iterator<Item = (u8, u8, &[u8])> {
    bytes.windows(HEAD).enumerate().filter_map(|(at, head)| {
        let &[0xB5, 0x62, class, identity, low, high] = head else { return None };
        let end = at + HEAD + usize::from(u16::from_le_bytes([low, high]));
        let is_sound = bytes.get(end..end + 2)? == checksum(bytes.get(at + 2..end)?);
        is_sound.then_some((class, identity, &bytes[at + HEAD..end]))
    })
}

/// Name of a packet, for the order of a burst.
pub(super) fn address(packet: &[u8]) -> String {
    format!("U{:02X}{:02X}", packet[2], packet[3])
}

fn packet_ref(packet: &[u8]) -> Result<PacketRef<'_>, Refusal> {
    let payload = &packet[HEAD..packet.len() - 2];
    Proto31::match_packet(packet[2], packet[3], payload).map_err(|_| Refusal::Malformed)
}

/// The report of a packet; `None` where it has no part of a fix.
pub(super) fn read(packet: &[u8]) -> Result<Option<Report>, Refusal> {
    match (packet[2], packet[3]) {
        (0x01, 0x07) if packet.len() == PVT_OLD + AROUND => {
            // The packet of the seventh generation is shorter; it lacks only fields that are not used here.
            let mut longer = packet[..HEAD + PVT_OLD].to_vec();
            longer.resize(HEAD + PVT_NEW + 2, 0);
            of_packet(&packet_ref(&longer)?)
        }
        (0x01, 0x07 | 0x21 | 0x36) | (0x0D, 0x01) => of_packet(&packet_ref(packet)?),
        _ => Ok(None),
    }
}

/// Payload of NAV-PVT up to the seventh generation, and in later ones.
const PVT_OLD: usize = 84;
const PVT_NEW: usize = 92;

fn of_packet(packet: &PacketRef<'_>) -> Result<Option<Report>, Refusal> {
    match packet {
        PacketRef::NavPvt(pvt) => solution(pvt).map(Some),
        PacketRef::NavCov(cov) => covariance(cov),
        PacketRef::NavTimeUTC(utc) => {
            let clock = Clock {
                time: [utc.hour(), utc.min(), utc.sec()],
                nanoseconds: utc.nanos(),
                date: (utc.year(), utc.month(), utc.day()),
            };
            let mut report = Report::new(Kind::Zda);
            let is_valid = utc.valid_raw() & 4 != 0;
            clock.fill(&mut report, is_valid, is_valid)?;
            Ok(Some(report))
        }
        PacketRef::TimTp(pulse) => next_pulse(pulse),
        _ => Err(Refusal::Malformed),
    }
}

fn solution(pvt: &NavPvtRef<'_>) -> Result<Report, Refusal> {
    let clock = Clock {
        time: [pvt.hour(), pvt.min(), pvt.sec()],
        nanoseconds: pvt.nanosec(),
        date: (pvt.year(), pvt.month(), pvt.day()),
    };
    let (valid, flags) = (pvt.valid_raw(), pvt.flags_raw());
    let mut report = Report::new(Kind::Pvt);
    let time = clock.fill(&mut report, valid & 2 != 0, valid & 1 != 0);
    report.optional("NAV-PVT time", time.map(Some));
    let ok = flags & 1 != 0;
    // Dead reckoning alone (1) and time alone (5) are not fixes.
    let fix = match pvt.fix_type_raw() {
        2 if ok => FixKind::TwoD,
        3 | 4 if ok => FixKind::ThreeD,
        _ => FixKind::None,
    };
    (report.fix, report.valid) = (Some(fix), Some(fix != FixKind::None));
    report.sats = Some(u32::from(pvt.num_satellites()));
    if fix == FixKind::None {
        return Ok(report);
    }
    let (lat, lon) = (pvt.latitude(), pvt.longitude());
    let there = (-90.0..=90.0).contains(&lat) && (-180.0..=180.0).contains(&lon);
    let position = if there { Ok(Some((lat, lon))) } else { Err(Refusal::OutOfRange) };
    report.position_deg = report.optional("NAV-PVT position", position);
    report.solution = Some(match flags >> 6 {
        1 => Solution::RtkFloat,
        2 => Solution::RtkFixed,
        _ => Solution::Code,
    });
    report.alt_msl_m = Some(pvt.height_msl());
    report.geoid_m = Some(pvt.height_above_ellipsoid() - pvt.height_msl());
    report.vel_ned_mps = Some(Vector3::new(pvt.vel_north(), pvt.vel_east(), pvt.vel_down()));
    report.speed_mps = Some(pvt.ground_speed_2d());
    report.course_deg = Some(pvt.heading_motion().rem_euclid(360.0));
    let (across, up, speed) = (pvt.horizontal_accuracy(), pvt.vertical_accuracy(), pvt.speed_accuracy());
    (report.hpe_m, report.vpe_m) = (Some(across), Some(up));
    // The errors of the whole horizontal position and speed: along one axis they are at most that.
    report.position_sigma_m = sigmas([across, across, up]);
    report.velocity_sigma_mps = sigmas([speed; 3]);
    Ok(report)
}

/// Its time of week is that of the solution with which it comes.
fn covariance(cov: &NavCovRef<'_>) -> Result<Option<Report>, Refusal> {
    let of = |valid: u8, variances: [f32; 3]| match valid {
        0 => Ok(None),
        _ => {
            sigmas(variances.map(|variance| f64::from(variance).sqrt())).ok_or(Refusal::OutOfRange).map(Some)
        }
    };
    let mut report = Report::new(Kind::Cov);
    let position = [cov.pos_cov_nn(), cov.pos_cov_ee(), cov.pos_cov_dd()];
    let velocity = [cov.vel_cov_nn(), cov.vel_cov_ee(), cov.vel_cov_dd()];
    report.position_sigma_m = report.optional("NAV-COV position", of(cov.pos_cov_valid(), position));
    report.velocity_sigma_mps = report.optional("NAV-COV velocity", of(cov.vel_cov_valid(), velocity));
    Ok(Some(report))
}

/// Plausible one-sigmas; `None` where one is zero, infinite or not a number.
fn sigmas(values: [f64; 3]) -> Option<Vector3<f64>> {
    values.iter().all(|sigma| sigma.is_finite() && *sigma > 0.0).then(|| Vector3::from(values))
}

/// TIM-TP: the time of the next pulse; `None` where it is not UTC.
fn next_pulse(pulse: &TimTpRef<'_>) -> Result<Option<Report>, Refusal> {
    let flags = pulse.flags();
    if flags.time_base() != TimTpTimeBase::Utc || !flags.utc_available() {
        return Ok(None);
    }
    let (week, of_week) = (i64::from(pulse.week()), i64::from(pulse.tow_ms()) * (NS_PER_S / 1_000));
    if week > WEEK_MAX || of_week > WEEK_NS {
        return Err(Refusal::OutOfRange);
    }
    let since_gps_began = week * WEEK_NS + of_week;
    let unix_ns = GPS_BEGAN.unix_ns() + since_gps_began;
    let mut report = Report::new(Kind::Pulse);
    report.time_of_day_ns = Some(unix_ns.rem_euclid(DAY_NS));
    let civil = UtcTime::from_unix_ns(unix_ns).civil();
    report.date = Date::new(civil.year, civil.month, civil.day);
    Ok(Some(report))
}

/// 1980-01-06, the start of the week count.
const GPS_BEGAN: UtcTime = UtcTime::from_unix_ns(315_964_800 * NS_PER_S);
const DAY_NS: i64 = 86_400 * NS_PER_S;
const WEEK_NS: i64 = 7 * DAY_NS;
/// Two centuries of weeks.
const WEEK_MAX: i64 = 10_000;

/// Flags of NAV-RELPOSNED that a heading needs: fix, relative position, float or fixed ambiguities (two bits), heading.
const RELATIVE: [u32; 4] = [1, 1 << 2, 3 << 3, 1 << 8];

/// The heading from one antenna to the other, degrees, of NAV-RELPOSNED: `Some(None)` where it is not valid, `None`
/// where this is another packet. The eighth generation's packet has none.
pub(super) fn relative_heading(packet: &[u8]) -> Result<Option<Option<f64>>, Refusal> {
    if (packet[2], packet[3]) != (0x01, 0x3C) || packet[HEAD..].first() == Some(&0) {
        return Ok(None);
    }
    let PacketRef::NavRelPosNed(relative) = packet_ref(packet)? else { return Ok(None) };
    let flags = relative.flags_raw();
    if RELATIVE.iter().any(|bits| flags & bits == 0) {
        return Ok(Some(None));
    }
    let degrees = relative.rel_pos_heading_degrees();
    if !(-360.0..=360.0).contains(&degrees) {
        return Err(Refusal::OutOfRange);
    }
    Ok(Some(Some(degrees.rem_euclid(360.0))))
}

/// Date and time as in the packets.
struct Clock {
    time: [u8; 3],
    nanoseconds: i32,
    date: (u16, u8, u8),
}

/// Resolution of the epochs' times, ns: the rest is the receiver's clock error.
const EPOCH_STEP_NS: i64 = 1_000_000;
/// The same for sentences, where the time is near such a step.
const SENTENCE_STEP_NS: i64 = 10_000_000;

impl Clock {
    fn fill(&self, report: &mut Report, has_time: bool, has_date: bool) -> Result<(), Refusal> {
        let [hour, minute, second] = self.time.map(i64::from);
        if !has_time {
            return Ok(());
        }
        let nanoseconds = i64::from(self.nanoseconds);
        if hour > 23 || minute > 59 || second > 60 || nanoseconds.abs() > NS_PER_S {
            return Err(Refusal::OutOfRange);
        }
        let exact_ns = (hour * 3600 + minute * 60 + second) * NS_PER_S + nanoseconds;
        let rounded = |step: i64| (exact_ns + step / 2).div_euclid(step) * step;
        let coarse_ns = rounded(SENTENCE_STEP_NS);
        let near = (coarse_ns - exact_ns).abs() <= EPOCH_STEP_NS;
        let time_ns = if near { coarse_ns } else { rounded(EPOCH_STEP_NS) };
        // A whole second before midnight may be reported as slightly before midnight.
        report.time_of_day_ns = Some(time_ns.max(0));
        if has_date {
            let (year, month, day) = self.date;
            report.date = Date::new(i32::from(year), month, day);
        }
        Ok(())
    }
}
