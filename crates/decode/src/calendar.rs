//! Dates of epochs: accepted only from a receiver with a fix, and checked for plausibility.

use super::report::Date;
use windhover_base::time::{Civil, EARLIEST_UTC, MonoTime, NS_PER_S, UtcTime};

/// A day, in nanoseconds.
const DAY_NS: i64 = 86_400 * NS_PER_S;
/// The span after which GPS's ten-bit week number repeats.
const ERA_NS: i64 = 1_024 * 7 * DAY_NS;
/// How near a date must be to the host's clock to be confirmed by it.
const CONFIRMED_NS: i64 = 2 * DAY_NS;
/// Largest error of the host's clock where it counts as set (boards without a battery continue from where they were
/// switched off).
const HOST_OFF_NS: i64 = 180 * DAY_NS;
/// How long after [`EARLIEST_UTC`] a date is accepted. Shorter than an era, so that the era of a date is known, and
/// short enough that the days 0 and 1024 weeks after the start of GPS are not taken for later ones.
const BELIEVED_NS: i64 = 10 * 365 * DAY_NS;

/// Assigns dates to times of day.
///
/// A date is accepted only with a fix: before it a receiver reports the first day of its memory. In a live stream the
/// date is compared with the host's clock and with [`EARLIEST_UTC`]: one whose week number has rolled over is corrected
/// where the era is known, and an impossible one is dropped. A recording without times of arrival may be of any year:
/// there the date is used unchanged.
#[derive(Clone, Debug)]
pub(super) struct Calendar {
    /// Whether arrivals are times of a clock.
    has_host: bool,
    last: Option<(UtcTime, MonoTime)>,
    date_alone: Option<Date>,
    had_fix: bool,
    refused: u64,
}

impl Calendar {
    pub(super) const fn new(has_host: bool) -> Self {
        Self { has_host, last: None, date_alone: None, had_fix: false, refused: 0 }
    }

    /// UTC of an epoch received at `t_recv`: with its own date, else with the day that is nearest to the last dated
    /// epoch plus the time since. `None` until a date was received with a fix.
    pub(super) fn utc_of(
        &mut self,
        time_of_day_ns: Option<i64>,
        date: Option<Date>,
        has_fix: bool,
        t_recv: MonoTime,
    ) -> Option<UtcTime> {
        self.had_fix = has_fix;
        let own = date.filter(|_| has_fix);
        let Some(time_of_day_ns) = time_of_day_ns else {
            self.date_alone = own.or(self.date_alone);
            return None;
        };
        let utc = match (own, self.last) {
            (Some(date), _) => self.dated(date, time_of_day_ns, t_recv)?,
            (None, Some(last)) => nearest(last, time_of_day_ns, t_recv),
            (None, None) => {
                let date = self.date_alone.filter(|_| has_fix)?;
                self.dated(date, time_of_day_ns, t_recv)?
            }
        };
        if has_fix {
            self.last = Some((utc, t_recv));
        }
        Some(utc)
    }

    /// A sentence outside of epochs reported date and time, while the receiver had a fix or not (`None`: as at the last
    /// epoch).
    pub(super) fn reported(
        &mut self,
        time_of_day_ns: i64,
        date: Date,
        has_fix: Option<bool>,
        t_recv: MonoTime,
    ) {
        if has_fix.unwrap_or(self.had_fix)
            && let Some(utc) = self.dated(date, time_of_day_ns, t_recv)
        {
            self.last = Some((utc, t_recv));
        }
    }

    /// Number of dates refused since the last call.
    pub(super) fn take_refused(&mut self) -> u64 {
        std::mem::take(&mut self.refused)
    }

    fn dated(&mut self, date: Date, time_of_day_ns: i64, t_recv: MonoTime) -> Option<UtcTime> {
        let said = utc_on(date, time_of_day_ns)?;
        let believed = if self.has_host { in_its_era(said, t_recv) } else { Some(said) };
        self.refused += u64::from(believed.is_none());
        believed
    }
}

/// The time of day on the day that is nearest to `last` plus the time since.
fn nearest((last, received): (UtcTime, MonoTime), time_of_day_ns: i64, t_recv: MonoTime) -> UtcTime {
    let expected = last.unix_ns().saturating_add((t_recv - received).ns());
    let midnight = expected.div_euclid(DAY_NS) * DAY_NS;
    let days = [-1, 0, 1].map(|day| midnight + day * DAY_NS + time_of_day_ns);
    let nearest = days.into_iter().min_by_key(|ns| (ns - expected).abs());
    UtcTime::from_unix_ns(nearest.unwrap_or(expected))
}

fn utc_on(date: Date, time_of_day_ns: i64) -> Option<UtcTime> {
    let midnight = Civil {
        year: date.year,
        month: date.month,
        day: date.day,
        hour: 0,
        minute: 0,
        second: 0,
        nanosecond: 0,
    };
    Some(UtcTime::from_unix_ns(UtcTime::from_civil(midnight)?.unix_ns() + time_of_day_ns))
}

/// The reported time, whole eras of 1024 weeks later where the receiver's week number has rolled over; `None` where
/// neither the host's clock nor the age of this program determines the era.
fn in_its_era(said: UtcTime, t_recv: MonoTime) -> Option<UtcTime> {
    let (said, host, earliest) = (said.unix_ns(), t_recv.ns(), EARLIEST_UTC.unix_ns());
    let rolled = |eras: i64| UtcTime::from_unix_ns(said.saturating_add(eras.saturating_mul(ERA_NS)));
    let by_host = (host.saturating_sub(said).saturating_add(ERA_NS / 2)).div_euclid(ERA_NS).max(0);
    let off = (rolled(by_host).unix_ns() - host).abs();
    if off <= if host >= earliest { HOST_OFF_NS } else { CONFIRMED_NS } {
        return Some(rolled(by_host));
    }
    if host >= earliest {
        return believed(UtcTime::from_unix_ns(said));
    }
    // The host's clock is not set: the first era in which this program exists.
    let eras = (earliest - said).max(0).saturating_add(ERA_NS - 1).div_euclid(ERA_NS);
    believed(rolled(eras))
}

fn believed(utc: UtcTime) -> Option<UtcTime> {
    (0..=BELIEVED_NS).contains(&utc.unix_ns().saturating_sub(EARLIEST_UTC.unix_ns())).then_some(utc)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn at(text: &str, calendar: &mut Calendar, date: Option<Date>, t_s: i64) -> String {
        of(text, calendar, date, true, t_s)
    }

    fn of(text: &str, calendar: &mut Calendar, date: Option<Date>, has_fix: bool, t_s: i64) -> String {
        let tod = super::super::report::time_of_day_ns(text).expect("a sound time");
        let t = MonoTime::from_ns(t_s * NS_PER_S);
        calendar.utc_of(tod, date, has_fix, t).map_or_else(|| "none".to_owned(), |utc| utc.to_string())
    }

    /// 2026-11-18T15:04:05Z.
    const HOST_S: i64 = 1_795_014_245;

    #[test]
    fn midnight_without_a_date_in_the_sentence() {
        let mut calendar = Calendar::new(false);
        assert_eq!(at("235959.8", &mut calendar, None, 0), "none");
        assert_eq!(at("235959.8", &mut calendar, Date::new(2026, 2, 28), 0), "2026-02-28T23:59:59.800Z");
        assert_eq!(at("000000.0", &mut calendar, None, 0), "2026-03-01T00:00:00.000Z");
        assert_eq!(at("235959.8", &mut calendar, None, 0), "2026-02-28T23:59:59.800Z");
    }

    #[test]
    fn days_of_silence_are_counted() {
        let mut calendar = Calendar::new(true);
        at("120000", &mut calendar, Date::new(2026, 2, 1), 1_000);
        assert_eq!(at("130000", &mut calendar, None, 1_000 + 3 * 86_400), "2026-02-04T13:00:00.000Z");
    }

    #[test]
    fn a_date_is_believed_only_with_a_fix() {
        for calendar in [Calendar::new(false), Calendar::new(true)] {
            let mut calendar = calendar;
            for date in [Date::new(1980, 1, 6), Date::new(2080, 1, 5), Date::new(2026, 11, 18)] {
                assert_eq!(of("235955.8", &mut calendar, date, false, HOST_S), "none");
                assert_eq!(of("235955.8", &mut calendar, None, false, HOST_S), "none");
            }
            assert_eq!(
                at("150405", &mut calendar, Date::new(2026, 11, 18), HOST_S),
                "2026-11-18T15:04:05.000Z"
            );
            // Its later reports without a fix do not move the day.
            assert_eq!(
                of("150406", &mut calendar, Date::new(1980, 1, 6), false, HOST_S + 1),
                "2026-11-18T15:04:06.000Z"
            );
            assert_eq!(at("150407", &mut calendar, None, HOST_S + 2), "2026-11-18T15:04:07.000Z");
        }
    }

    #[test]
    fn a_rolled_over_week_is_put_right() {
        // 2026-11-18 minus 1024 weeks is 2007-04-04
        let at = |date, host_s| at("150405", &mut Calendar::new(true), date, host_s);
        let old = Date::new(2007, 4, 4);
        let right = "2026-11-18T15:04:05.000Z";
        assert_eq!(at(old, HOST_S), right);
        assert_eq!(at(old, HOST_S - 30 * 86_400), right, "the host's clock stood still for a month");
        assert_eq!(at(old, 0), right, "the host's clock is not set");
        assert_eq!(at(old, 100_000_000), right, "nor here");
        assert_eq!(at(old, 1_175_699_045), "2007-04-04T15:04:05.000Z", "a recording of that day");
        assert_eq!(at(Date::new(1987, 8, 19), HOST_S), right, "two eras");
        assert_eq!(at(Date::new(2026, 11, 18), 0), right);
    }

    #[test]
    fn a_date_that_cannot_be_is_none() {
        let mut calendar = Calendar::new(true);
        for date in [
            Date::new(1980, 1, 6),
            Date::new(1999, 8, 22),
            Date::new(2019, 4, 7),
            Date::new(2080, 1, 5),
            Date::new(2021, 5, 5),
        ] {
            for host_s in [0, HOST_S] {
                assert_eq!(at("000005", &mut calendar, date, host_s), "none", "{date:?} {host_s}");
            }
        }
        assert_eq!((calendar.take_refused(), calendar.take_refused()), (10, 0));
        assert_eq!(
            at("000005", &mut Calendar::new(false), Date::new(2021, 5, 5), 0),
            "2021-05-05T00:00:05.000Z"
        );
    }

    #[test]
    fn a_date_reported_beside_the_epochs_counts_like_theirs() {
        let (mut calendar, t) = (Calendar::new(true), MonoTime::from_ns(HOST_S * NS_PER_S));
        let date = Date::new(2026, 11, 18).expect("a day");
        let time_of_day_ns = 54_247 * NS_PER_S;
        calendar.reported(time_of_day_ns, date, None, t);
        assert_eq!(at("150405", &mut calendar, None, HOST_S), "none", "there was no fix yet");
        calendar.reported(time_of_day_ns, date, None, t);
        assert_eq!(at("150405", &mut calendar, None, HOST_S), "2026-11-18T15:04:05.000Z");
    }

    #[test]
    fn a_leap_second_is_the_second_after() {
        let utc = at("235960.5", &mut Calendar::new(false), Date::new(2016, 12, 31), 0);
        assert_eq!(utc, "2017-01-01T00:00:00.500Z");
    }

    proptest! {
        #[test]
        fn what_is_said_is_a_day_that_can_be_whatever_clock_and_receiver_say(
            day in 3_650i64..40_000,
            time_ns in 0i64..DAY_NS,
            host_s in prop_oneof![0i64..4_000_000_000, Just(0), Just(HOST_S)],
        ) {
            let civil = UtcTime::from_unix_ns(day * DAY_NS).civil();
            let date = Date::new(civil.year, civil.month, civil.day);
            let host = MonoTime::from_ns(host_s * NS_PER_S);
            if let Some(utc) = Calendar::new(true).utc_of(Some(time_ns), date, true, host) {
                let said = day * DAY_NS + time_ns;
                let eras = utc.unix_ns() - said;
                prop_assert!(eras >= 0 && eras % ERA_NS == 0, "only whole eras are added");
                let near_host = (utc.unix_ns() - host.ns()).abs() <= HOST_OFF_NS;
                prop_assert!(near_host || believed(utc).is_some());
            }
        }
    }
}
