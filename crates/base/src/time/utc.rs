//! UTC as the receiver reports it, and its calendar form.

use std::fmt;

use super::NS_PER_S;

/// A point in UTC: nanoseconds since 1970-01-01 without leap seconds (POSIX). Second 60 of a leap
/// minute maps to the second after it, as POSIX does.
///
/// ```
/// use windhover_base::time::UtcTime;
///
/// let t = UtcTime::from_unix_ns(1_795_014_245_500_000_000);
/// assert_eq!(t.to_string(), "2026-11-18T15:04:05.500Z");
/// assert_eq!(t.compact(), "20261118T150405Z");
/// assert_eq!(UtcTime::from_civil(t.civil()), Some(t));
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct UtcTime(i64);

/// Dates before this are a device's error (a week number that rolled over, a clock without a battery), because this
/// program is newer. 2026-01-01.
pub const EARLIEST_UTC: UtcTime = UtcTime::from_unix_ns(1_767_225_600_000_000_000);

/// A calendar date and time of day in UTC.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Civil {
    /// Year of the common era.
    pub year: i32,
    /// Month, 1 to 12.
    pub month: u8,
    /// Day of the month, 1 to 31.
    pub day: u8,
    /// Hour, 0 to 23.
    pub hour: u8,
    /// Minute, 0 to 59.
    pub minute: u8,
    /// Second, 0 to 60.
    pub second: u8,
    /// Nanosecond within the second.
    pub nanosecond: u32,
}

impl UtcTime {
    /// The instant `ns` nanoseconds after 1970-01-01T00:00:00Z.
    pub const fn from_unix_ns(ns: i64) -> Self {
        Self(ns)
    }

    /// Nanoseconds after 1970-01-01T00:00:00Z.
    pub const fn unix_ns(self) -> i64 {
        self.0
    }

    /// From a calendar form; `None` where a field is out of range.
    pub fn from_civil(c: Civil) -> Option<Self> {
        let in_range = (1..=12).contains(&c.month)
            && c.day >= 1
            && c.day <= days_in_month(c.year, c.month)
            && c.hour < 24
            && c.minute < 60
            && c.second <= 60
            && i64::from(c.nanosecond) < NS_PER_S
            && (1678..=2261).contains(&c.year);
        if !in_range {
            return None;
        }
        let days = days_from_civil(c.year, c.month, c.day);
        let seconds =
            days * 86_400 + i64::from(c.hour) * 3_600 + i64::from(c.minute) * 60 + i64::from(c.second);
        Some(Self(seconds * NS_PER_S + i64::from(c.nanosecond)))
    }

    /// The calendar form.
    pub fn civil(self) -> Civil {
        let seconds = self.0.div_euclid(NS_PER_S);
        let (days, rest) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
        let (year, month, day) = civil_from_days(days);
        Civil {
            year,
            month,
            day,
            hour: (rest / 3_600) as u8,
            minute: (rest / 60 % 60) as u8,
            second: (rest % 60) as u8,
            nanosecond: self.0.rem_euclid(NS_PER_S) as u32,
        }
    }

    /// `YYYYMMDDTHHMMSSZ`, as flight directories are named.
    pub fn compact(self) -> String {
        let c = self.civil();
        format!("{:04}{:02}{:02}T{:02}{:02}{:02}Z", c.year, c.month, c.day, c.hour, c.minute, c.second)
    }
}

impl fmt::Display for UtcTime {
    /// ISO 8601 with milliseconds.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let c = self.civil();
        write!(
            f,
            "{:04}-{:02}-{:02}T{:02}:{:02}:{:02}.{:03}Z",
            c.year,
            c.month,
            c.day,
            c.hour,
            c.minute,
            c.second,
            c.nanosecond / 1_000_000
        )
    }
}

impl fmt::Debug for UtcTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Days in a month of the Gregorian calendar.
///
/// ```
/// assert_eq!(windhover_base::time::days_in_month(2028, 2), 29);
/// assert_eq!(windhover_base::time::days_in_month(2100, 2), 28);
/// ```
pub fn days_in_month(year: i32, month: u8) -> u8 {
    match month {
        4 | 6 | 9 | 11 => 30,
        2 if year % 4 == 0 && (year % 100 != 0 || year % 400 == 0) => 29,
        2 => 28,
        _ => 31,
    }
}

/// Days since 1970-01-01 of a Gregorian date: count in eras of 400 years, years starting in March.
fn days_from_civil(year: i32, month: u8, day: u8) -> i64 {
    let y = i64::from(year) - i64::from(month <= 2);
    let era = y.div_euclid(400);
    let year_of_era = y.rem_euclid(400);
    let month_from_march = (i64::from(month) + 9) % 12;
    let day_of_year = (153 * month_from_march + 2) / 5 + i64::from(day) - 1;
    let day_of_era = year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year;
    era * 146_097 + day_of_era - 719_468
}

/// The Gregorian date of a day counted from 1970-01-01; the inverse of [`days_from_civil`].
fn civil_from_days(days: i64) -> (i32, u8, u8) {
    let z = days + 719_468;
    let era = z.div_euclid(146_097);
    let day_of_era = z.rem_euclid(146_097);
    let year_of_era = (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = (day_of_year - (153 * month_from_march + 2) / 5 + 1) as u8;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 } as u8;
    let year = year_of_era + era * 400 + i64::from(month <= 2);
    (year as i32, month, day)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calendar_goes_there_and_back() {
        for ns in [0, -1, 951_782_400_000_000_000, 1_795_014_245_501_037_600, -86_400_000_000_001] {
            let utc = UtcTime::from_unix_ns(ns);
            assert_eq!(UtcTime::from_civil(utc.civil()), Some(utc), "{utc}");
        }
        let leap_day = UtcTime::from_unix_ns(951_782_400_000_000_000).civil();
        assert_eq!((leap_day.year, leap_day.month, leap_day.day), (2000, 2, 29));
    }

    #[test]
    fn leap_second_is_the_second_after() {
        let last = Civil { year: 2016, month: 12, day: 31, hour: 23, minute: 59, second: 60, nanosecond: 0 };
        let utc = UtcTime::from_civil(last).expect("a leap second is valid");
        assert_eq!(utc.to_string(), "2017-01-01T00:00:00.000Z");
    }

    #[test]
    fn absurd_dates_are_refused() {
        let ok = Civil { year: 2026, month: 2, day: 28, hour: 0, minute: 0, second: 0, nanosecond: 0 };
        assert!(UtcTime::from_civil(ok).is_some());
        assert!(UtcTime::from_civil(Civil { day: 29, ..ok }).is_none());
        assert!(UtcTime::from_civil(Civil { month: 13, ..ok }).is_none());
        assert!(UtcTime::from_civil(Civil { hour: 24, ..ok }).is_none());
    }
}
