//! The report of one sentence about a fix, for all kinds of sentences.

use nalgebra::Vector3;

use super::counts::Refusal;
use super::sentence::number;
use windhover_base::msg::FixKind;
use windhover_base::time::{NS_PER_S, days_in_month};

/// Sentences of an epoch.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub(super) enum Kind {
    Gga,
    Gns,
    Rmc,
    Gll,
    Pgrmf,
    Gsa,
    Vtg,
    Zda,
    Pgrme,
    Pgrmv,
    Gst,
    /// u-blox NAV-PVT.
    Pvt,
    /// u-blox NAV-COV.
    Cov,
    /// u-blox TIM-TP.
    Pulse,
}

impl Kind {
    /// Whether the sentence has a field for the time, filled or not.
    pub(super) const fn tells_time(self) -> bool {
        matches!(self, Self::Gga | Self::Gns | Self::Rmc | Self::Gll | Self::Pgrmf | Self::Zda | Self::Pvt)
    }
}

/// A calendar date.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Date {
    pub year: i32,
    pub month: u8,
    pub day: u8,
}

impl Date {
    /// A checked date; `None` where the day does not exist.
    pub(super) fn new(year: i32, month: u8, day: u8) -> Option<Self> {
        let real = (1..=12).contains(&month) && day >= 1 && day <= days_in_month(year, month);
        real.then_some(Self { year, month, day })
    }

    /// `ddmmyy` as in RMC and PGRMF, also without a leading zero; years 83 to 99 are of the last century, because NMEA 0183 is of 1983. `None` where
    /// empty or not a day.
    pub(super) fn of_ddmmyy(text: &str) -> Option<Self> {
        if !(5..=6).contains(&text.len()) || !text.bytes().all(|byte| byte.is_ascii_digit()) {
            return None;
        }
        let text = format!("{text:0>6}");
        let two = |from: usize| text[from..from + 2].parse::<u8>().ok();
        let year = i32::from(two(4)?);
        Self::new(if year >= 83 { 1900 + year } else { 2000 + year }, two(2)?, two(0)?)
    }
}

/// How a position was measured: from codes, or from carrier phases with float or fixed ambiguities.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(super) enum Solution {
    Code,
    RtkFloat,
    RtkFixed,
}

/// The content of one sentence. Positions and motion are left out where the sentence marks them as void.
#[derive(Clone, PartialEq, Debug)]
pub(super) struct Report {
    /// Its kind.
    pub kind: Kind,
    /// Nanoseconds since UTC midnight; from 86 400 s on during a leap second.
    pub time_of_day_ns: Option<i64>,
    pub date: Option<Date>,
    /// Whether the sentence marks its fix as valid.
    pub valid: Option<bool>,
    /// Kind of fix where the sentence has it.
    pub fix: Option<FixKind>,
    /// How the position was measured, where the sentence has it.
    pub solution: Option<Solution>,
    /// Latitude and longitude, degrees.
    pub position_deg: Option<(f64, f64)>,
    pub alt_msl_m: Option<f64>,
    pub geoid_m: Option<f64>,
    pub speed_mps: Option<f64>,
    pub course_deg: Option<f64>,
    pub vel_ned_mps: Option<Vector3<f64>>,
    pub hpe_m: Option<f64>,
    pub vpe_m: Option<f64>,
    /// One-sigma of position and velocity along north, east, down.
    pub position_sigma_m: Option<Vector3<f64>>,
    pub velocity_sigma_mps: Option<Vector3<f64>>,
    /// Number of satellites used.
    pub sats: Option<u32>,
    /// Number of satellites used in GSA's list; there is one GSA for each constellation.
    pub sats_listed: Option<u32>,
    pub hdop: Option<f64>,
    /// Fields with impossible values: the sentence is used without them.
    pub left_out: Vec<&'static str>,
}

impl Report {
    pub(super) const fn new(kind: Kind) -> Self {
        Self {
            kind,
            time_of_day_ns: None,
            date: None,
            valid: None,
            fix: None,
            solution: None,
            position_deg: None,
            alt_msl_m: None,
            geoid_m: None,
            speed_mps: None,
            course_deg: None,
            vel_ned_mps: None,
            hpe_m: None,
            vpe_m: None,
            position_sigma_m: None,
            velocity_sigma_mps: None,
            sats: None,
            sats_listed: None,
            hdop: None,
            left_out: Vec::new(),
        }
    }

    /// Takes the value of a field, or notes that it is impossible.
    pub(super) fn optional<T>(&mut self, name: &'static str, read: Result<Option<T>, Refusal>) -> Option<T> {
        read.unwrap_or_else(|_| {
            self.left_out.push(name);
            None
        })
    }
}

/// Time of day from `hhmmss[.fraction]`, nanoseconds; second 60 only in the day's last minute. As in angles the last two digits
/// before the point are seconds, whatever the number of leading zeros.
pub(super) fn time_of_day_ns(text: &str) -> Result<Option<i64>, Refusal> {
    if text.is_empty() {
        return Ok(None);
    }
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits = |part: &str| part.bytes().all(|byte| byte.is_ascii_digit());
    if !(1..=6).contains(&whole.len()) || !digits(whole) || !digits(fraction) || fraction.len() > 9 {
        return Err(Refusal::Malformed);
    }
    let whole = format!("{whole:0>6}");
    let two = |from: usize| whole[from..from + 2].parse::<i64>().map_err(|_| Refusal::Malformed);
    let (hour, minute, second) = (two(0)?, two(2)?, two(4)?);
    let leap = (hour, minute, second) == (23, 59, 60);
    if hour > 23 || minute > 59 || (second > 59 && !leap) {
        return Err(Refusal::OutOfRange);
    }
    let fraction_ns: i64 = format!("{fraction:0<9}").parse().map_err(|_| Refusal::Malformed)?;
    Ok(Some((hour * 3600 + minute * 60 + second) * NS_PER_S + fraction_ns))
}

/// Degrees from `dddmm.mmmm` and its hemisphere letter; `None` where the number is empty. The last two digits before
/// the point are minutes, whatever the number of digits before them: receivers differ in the number of leading zeros.
pub(super) fn angle_deg(
    text: &str,
    letter: &str,
    positive: &str,
    negative: &str,
) -> Result<Option<f64>, Refusal> {
    if text.is_empty() {
        return Ok(None);
    }
    let whole = text.find('.').unwrap_or(text.len());
    if !text.bytes().enumerate().all(|(index, byte)| byte.is_ascii_digit() || index == whole) {
        return Err(Refusal::Malformed);
    }
    let (degrees, minutes) = text.split_at(whole.saturating_sub(2));
    let limit = if positive == "N" { 90.0 } else { 180.0 };
    let degrees = number(degrees, 0.0, limit)?.unwrap_or(0.0);
    let minutes = number(minutes, 0.0, 60.0)?.ok_or(Refusal::Malformed)?;
    let angle = degrees + minutes / 60.0;
    if minutes >= 60.0 || angle > limit {
        return Err(Refusal::OutOfRange);
    }
    match letter {
        l if l == positive => Ok(Some(angle)),
        l if l == negative => Ok(Some(-angle)),
        _ => Err(Refusal::Malformed),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn times_of_day_to_the_nanosecond() {
        assert_eq!(time_of_day_ns("000001.2"), Ok(Some(1_200_000_000)));
        assert_eq!(time_of_day_ns("235960.5"), Ok(Some(86_400_500_000_000)));
        assert_eq!(time_of_day_ns(""), Ok(None));
        assert_eq!(time_of_day_ns("93021.00"), time_of_day_ns("093021"));
        assert_eq!(time_of_day_ns("3021"), time_of_day_ns("003021"));
        assert_eq!(time_of_day_ns("0.5"), Ok(Some(500_000_000)));
        assert_eq!(time_of_day_ns(".5"), Err(Refusal::Malformed));
        assert_eq!(time_of_day_ns("9961"), Err(Refusal::OutOfRange));
        assert_eq!(time_of_day_ns("115960"), Err(Refusal::OutOfRange));
        assert_eq!(time_of_day_ns("240000"), Err(Refusal::OutOfRange));
        assert_eq!(time_of_day_ns("1234567"), Err(Refusal::Malformed));
        assert_eq!(time_of_day_ns("12-456"), Err(Refusal::Malformed));
    }

    #[test]
    fn angles_are_degrees_and_minutes() {
        assert_eq!(angle_deg("4530.000", "S", "N", "S"), Ok(Some(-45.5)));
        assert_eq!(angle_deg("09900.000", "W", "E", "W"), Ok(Some(-99.0)));
        assert_eq!(angle_deg("9912.0", "N", "N", "S"), Err(Refusal::OutOfRange));
        assert_eq!(angle_deg("4560.0", "N", "N", "S"), Err(Refusal::OutOfRange));
        assert_eq!(angle_deg("4530.0", "", "N", "S"), Err(Refusal::Malformed));
        assert_eq!(angle_deg("", "", "N", "S"), Ok(None));
        for text in [".", "-4530.0", "45.30.0", "+1", "45 30"] {
            assert_eq!(angle_deg(text, "N", "N", "S"), Err(Refusal::Malformed), "{text}");
        }
    }

    #[test]
    fn minutes_are_counted_from_the_decimal_point() {
        let east = |text| angle_deg(text, "E", "E", "W").expect("sound").expect("given");
        for (text, degrees, minutes) in [
            ("100.102", 1.0, 0.102),
            ("1026.6634", 10.0, 26.6634),
            ("530.445", 5.0, 30.445),
            ("26.5", 0.0, 26.5),
            ("6.5", 0.0, 6.5),
            (".5", 0.0, 0.5),
            ("0000100.102", 1.0, 0.102),
            ("17959", 179.0, 59.0),
            ("18000.", 180.0, 0.0),
        ] {
            assert_eq!(east(text), degrees + minutes / 60.0, "{text}");
        }
    }

    proptest! {
        #[test]
        fn an_angle_reads_the_same_however_many_zeros_are_written(
            degrees in 0u32..180,
            minutes_e4 in 0u32..600_000,
            zeros in 0usize..4,
            west: bool,
        ) {
            let fraction = minutes_e4 % 10_000;
            let plain = format!("{}.{fraction:04}", degrees * 100 + minutes_e4 / 10_000);
            let padded = format!("{degrees:03}{:02}.{fraction:04}", minutes_e4 / 10_000);
            let letter = if west { "W" } else { "E" };
            let read = |text: &str| angle_deg(text, letter, "E", "W").expect("sound").expect("given");
            let size = f64::from(degrees) + f64::from(minutes_e4) / 600_000.0;
            let angle = if west { -size } else { size };
            prop_assert!((read(&plain) - angle).abs() < 1e-12);
            prop_assert_eq!(read(&padded), read(&plain));
            prop_assert_eq!(read(&format!("{}{plain}", "0".repeat(zeros))), read(&plain));
        }
    }

    #[test]
    fn dates_are_days_that_exist() {
        assert_eq!(Date::of_ddmmyy("290224"), Date::new(2024, 2, 29));
        assert!(Date::of_ddmmyy("290223").is_none());
        assert!(Date::of_ddmmyy("000000").is_none());
        assert_eq!(Date::of_ddmmyy("10226"), Date::new(2026, 2, 1));
        assert!(Date::of_ddmmyy("226").is_none());
        assert_eq!(Date::of_ddmmyy("060183").map(|date| date.year), Some(1983));
    }
}
