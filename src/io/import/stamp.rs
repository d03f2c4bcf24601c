//! Times as people and tools write them.
//!
//! | form | example |
//! |---|---|
//! | seconds since any epoch, with point or comma | `1795014245.5010376`, `12,5` |
//! | whole milliseconds, microseconds, nanoseconds since 1970, by their 13, 16 or 19 digits | `1795014245501` |
//! | ISO 8601, with `T` or a blank, any fraction, any offset or none (UTC) | `2026-11-18 16:04:05,501+0100` |
//! | the same with slashes, or without separators | `2026/11/18 15:04:05.5`, `20261118T150405.5Z` |
//! | the form of the C library, as `gpspipe -t` has by default | `Wed Nov 18 15:04:05 2026` |
//!
//! In a log a blank, a tab, or a colon and a blank (`gpspipe`) follow the time. It may be in brackets, and blanks may stand before
//! it.

use chrono::{DateTime, FixedOffset, NaiveDateTime};

use windhover_base::time::MonoTime;

/// Longest time at the start of a line.
const LONGEST: usize = 48;

/// A time in any of the forms.
pub fn parse_time(text: &str) -> Option<MonoTime> {
    let point = text.replace(',', ".");
    if let Some(ns) = seconds_to_ns(&point) {
        return Some(MonoTime::from_ns(ns));
    }
    let zoned = [
        "%Y-%m-%dT%H:%M:%S%.f%#z",
        "%Y-%m-%d %H:%M:%S%.f%#z",
        "%Y-%m-%d %H:%M:%S%.f %#z",
        "%Y/%m/%d %H:%M:%S%.f%#z",
        "%Y%m%dT%H%M%S%.f%#z",
    ];
    let zoned = zoned.iter().find_map(|form| DateTime::<FixedOffset>::parse_from_str(&point, form).ok());
    let plain = || {
        let point = point.strip_suffix('Z').or_else(|| point.strip_suffix(" UTC")).unwrap_or(&point);
        let forms = [
            "%Y-%m-%dT%H:%M:%S%.f",
            "%Y-%m-%d %H:%M:%S%.f",
            "%Y/%m/%d %H:%M:%S%.f",
            "%Y%m%dT%H%M%S%.f",
            "%a %b %e %H:%M:%S %Y%.f",
            "%a %b %e %H:%M:%S%.f %Y",
        ];
        let plain = forms.iter().find_map(|form| NaiveDateTime::parse_from_str(point, form).ok());
        plain.map(|time| time.and_utc().fixed_offset())
    };
    Some(MonoTime::from_ns(zoned.or_else(plain)?.timestamp_nanos_opt()?))
}

/// The time at the start of a log's line, and the rest of the line: the longest prefix that is a time.
pub(super) fn timed(line: &[u8]) -> Option<(MonoTime, &[u8])> {
    let line = &line[line.iter().take_while(|byte| **byte == b' ').count()..];
    let head = &line[..line.len().min(LONGEST)];
    let ends = head.iter().enumerate().rev().filter(|(_, byte)| matches!(byte, b' ' | b'\t'));
    ends.map(|(at, _)| at).find_map(|at| {
        let text = std::str::from_utf8(&line[..at]).ok()?;
        let text = text.strip_suffix(':').unwrap_or(text);
        let within = |open: char, close: char| text.strip_prefix(open)?.strip_suffix(close);
        let text = within('[', ']').or_else(|| within('(', ')')).unwrap_or(text);
        Some((parse_time(text)?, &line[at + 1..]))
    })
}

/// Decimal seconds to nanoseconds without floating point, which would lose a fraction of a microsecond in present-day
/// epochs.
fn seconds_to_ns(text: &str) -> Option<i64> {
    let (negative, digits) = text.strip_prefix('-').map_or((false, text), |rest| (true, rest));
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let all_digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || !all_digits(whole) || !all_digits(fraction) {
        return None;
    }
    let unit_ns = match (whole.len(), fraction) {
        (13, "") => 1_000_000,
        (16, "") => 1_000,
        (19, "") => 1,
        _ => 1_000_000_000,
    };
    let nanos: String = fraction.chars().chain("000000000".chars()).take(9).collect();
    let ns = whole.parse::<i64>().ok()?.checked_mul(unit_ns)?.checked_add(nanos.parse().ok()?)?;
    Some(if negative { -ns } else { ns })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_in_every_form() {
        let want = MonoTime::from_ns(1_795_014_245_501_037_600);
        for text in [
            "1795014245.5010376",
            "1795014245,5010376",
            "2026-11-18T15:04:05.501037600Z",
            "2026-11-18T16:04:05.5010376+01:00",
            "2026-11-18T16:04:05,5010376+0100",
            "2026-11-18T13:04:05,5010376-02",
            "2026-11-18 16:04:05.5010376 +0100",
            "2026-11-18 15:04:05.5010376",
            "2026-11-18 15:04:05,5010376Z",
            "2026-11-18 15:04:05.5010376 UTC",
            "2026-11-18T15:04:05.5010376",
            "Wed Nov 18 15:04:05 2026.5010376",
            "Wed Nov 18 15:04:05.5010376 2026",
            "2026/11/18 15:04:05.5010376",
            "2026/11/18 16:04:05,5010376+01:00",
            "20261118T150405.5010376Z",
            "20261118T150405,5010376",
            "20261118T160405.5010376+0100",
            "1795014245501037600",
        ] {
            assert_eq!(parse_time(text), Some(want), "{text}");
        }
        assert_eq!(parse_time("1795014245501"), Some(MonoTime::from_ns(1_795_014_245_501_000_000)));
        assert_eq!(parse_time("1795014245501037"), Some(MonoTime::from_ns(1_795_014_245_501_037_000)));
        assert_eq!(parse_time("12"), Some(MonoTime::from_ns(12_000_000_000)));
        assert_eq!(parse_time("Sun Mar  1 00:00:01 1970"), Some(MonoTime::from_ns(5_097_601_000_000_000)));
        for wrong in
            ["", "-", "1.2.3", "1,2,3", "$GPRMC", "yesterday", "1e9", "99999999999999999999", "2026-11-18"]
        {
            assert_eq!(parse_time(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn what_came_over_the_line_is_what_follows_the_time() {
        let t = MonoTime::from_ns(1_795_014_245_500_000_000);
        for time in [
            "1795014245.5",
            "1795014245,5",
            "2026-11-18T15:04:05.5Z",
            "2026-11-18 15:04:05,5",
            "2026-11-18 16:04:05.500 +0100",
            "Wed Nov 18 15:04:05 2026.500000:",
            "2026-11-18 15:04:05.500000:",
            "[2026-11-18 15:04:05.5]",
            "(1795014245.500000)",
            "  1795014245.5",
        ] {
            for sent in ["$GPGGA,150405.5,3842.2,N", "12.5, 1.0, -2.0", "C12.5P1.0", "12 34", "", " x"] {
                for blank in [" ", "\t"] {
                    let line = format!("{time}{blank}{sent}");
                    assert_eq!(timed(line.as_bytes()), Some((t, sent.as_bytes())), "{line}");
                }
            }
        }
        for line in ["$GPGGA,150405.5,3842.2,N", "12.5,1.0 2", "", " ", "x 12"] {
            assert_eq!(timed(line.as_bytes()), None, "{line}");
        }
        // Bytes that are not text may follow.
        assert_eq!(
            timed(b"12 \xb5\x62\x01 \xff"),
            Some((MonoTime::from_ns(12_000_000_000), &b"\xb5\x62\x01 \xff"[..]))
        );
    }
}
