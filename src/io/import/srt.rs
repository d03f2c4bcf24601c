//! The subtitles that DJI's cameras write beside a video (`.SRT`): the position of the helicopter, cue by cue.
//!
//! | form | used |
//! |---|---|
//! | `[latitude: 47.1] [longitude: 8.1] [rel_alt: 10.3 abs_alt: 512.3]`, also `longtitude`, `altitude` | since 2018 |
//! | `GPS(8.1,47.1,19)`, `GPS (8.1, 47.1, 19)`: longitude first | earlier, and by small ones |

use super::measured::{Fix, ImportedLog, Measured, MeasuredLog};
use super::stamp::parse_time;
use crate::text::number;
use windhover_base::time::{MonoTime, Span};

/// An unchanged place is repeated as a fix after this time: cues come with every frame.
const AGAIN: Span = Span::from_ns(1_000_000_000);

/// Whether a file begins like subtitles: a number, then a time.
pub(super) fn is_one(text: &str) -> bool {
    let mut lines =
        text.trim_start_matches('\u{feff}').lines().map(str::trim).filter(|line| !line.is_empty());
    lines.next().is_some_and(|line| line.parse::<u32>().is_ok())
        && lines.next().is_some_and(|line| cue_start(line).is_some())
}

/// `HH:MM:SS,mmm --> …`
fn cue_start(line: &str) -> Option<Span> {
    let (from, _) = line.split_once("-->")?;
    let (clock, ms) = from.trim().split_once([',', '.'])?;
    let mut parts = clock.split(':').map(|part| part.parse::<i64>().ok());
    let (h, m, s) = (parts.next()??, parts.next()??, parts.next()??);
    let ms: i64 = ms.parse().ok().filter(|ms| (0..1000).contains(ms))?;
    let fits = (0..100).contains(&h) && (0..60).contains(&m) && (0..60).contains(&s);
    fits.then(|| Span::from_ns((((h * 60 + m) * 60 + s) * 1000 + ms) * 1_000_000))
}

/// The figure after `key:` in a cue.
fn figure(text: &str, key: &str) -> Option<f64> {
    let mut rest = text;
    loop {
        let at = rest.find(key)?;
        let before = rest[..at].chars().next_back();
        rest = &rest[at + key.len()..];
        // `altitude` must not be the end of another word.
        if before.is_none_or(|c| !c.is_ascii_alphanumeric() && c != '_')
            && let Some(value) = rest.trim_start().strip_prefix(':')
        {
            let value = value.trim_start();
            let end = value.find(|c: char| !(c.is_ascii_digit() || "+-.".contains(c))).unwrap_or(value.len());
            return number(&value[..end]).ok();
        }
    }
}

/// Latitude, longitude, height above the sea.
type Place = (f64, f64, Option<f64>);

/// The place in a cue.
fn place(text: &str) -> Option<Place> {
    if let Some(lat) = figure(text, "latitude") {
        let lon = figure(text, "longitude").or_else(|| figure(text, "longtitude"))?;
        return Some((lat, lon, figure(text, "abs_alt").or_else(|| figure(text, "altitude"))));
    }
    let (_, rest) = text.split_once("GPS")?;
    let list = rest.trim_start().strip_prefix('(')?.split_once(')')?.0;
    let mut figures = list.split(',').map(|figure| number(figure.trim()).ok());
    let (lon, lat) = (figures.next()??, figures.next()??);
    Some((lat, lon, None))
}

/// The date in a cue.
fn date(text: &str) -> Option<MonoTime> {
    text.lines().find_map(|line| {
        let line = line.trim();
        let line = line.get(
            ..line.find(|c: char| !(c.is_ascii_digit() || "-: .,T".contains(c))).unwrap_or(line.len()),
        )?;
        // Both 12:00:00.123 and 12:00:00,123,456.
        let mut parts = line.trim_end_matches([',', ' ']).splitn(2, ',');
        let (clock, rest) = (parts.next()?, parts.next());
        let whole =
            rest.map_or(clock.to_owned(), |fraction| format!("{clock}.{}", fraction.replace(',', "")));
        parse_time(whole.trim()).filter(|t| line.contains('-') && t.ns() > 0)
    })
}

/// Reads subtitles. The video began at `start`; where that is not given, at the first cue's own date (in whatever time
/// zone its clock was set), else at zero.
pub(super) fn read(text: &str, name: &str, start: Option<MonoTime>) -> ImportedLog {
    let mut log = MeasuredLog::default();
    let text = text.replace('\r', "");
    let cues: Vec<(Span, &str)> = text
        .split("\n\n")
        .filter_map(|cue| {
            let mut lines = cue.trim_start_matches(['\n', '\u{feff}']).splitn(3, '\n');
            let (_, times, words) = (lines.next()?, lines.next()?, lines.next()?);
            Some((cue_start(times)?, words))
        })
        .collect();
    let dated = cues.first().and_then(|(at, words)| Some(date(words)? - *at));
    let base = start.or(dated);
    log.is_utc = base.is_some();
    let base = base.unwrap_or_default();
    let mut last: Option<(MonoTime, Place)> = None;
    for (at, words) in &cues {
        let t = base + *at;
        // Zeros are written where there is no fix.
        let Some(place) = place(words).filter(|place| (place.0, place.1) != (0.0, 0.0)) else { continue };
        if last.is_some_and(|(then, same)| same == place && t - then < AGAIN) {
            continue;
        }
        last = Some((t, place));
        let (lat_deg, lon_deg, height) = place;
        let kind = if height.is_some() { 3 } else { 2 };
        log.push(t, Measured::Fix(Fix::at(kind, lat_deg, lon_deg, height.unwrap_or(0.0))), "subtitles");
    }
    if log.measured.is_empty() {
        log.warnings.push(format!("{name}: none of its {} cues has a place", cues.len()));
    }
    let video_start = (!cues.is_empty()).then_some(base);
    ImportedLog { video_start, ..log.into_packets("DJI SRT") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cues_of_every_form_tell_their_place() {
        let new = "<font size=\"28\">FrameCnt: 1, DiffTime: 33ms\n2023-05-01 12:00:00.123\n[iso: 100] [latitude: 47.5] \
                   [longitude: -8.25] [rel_alt: 10.3 abs_alt: 512.3] </font>";
        assert_eq!(place(new), Some((47.5, -8.25, Some(512.3))));
        assert_eq!(date(new), parse_time("2023-05-01 12:00:00.123"));
        let misspelt = "[latitude : 47.5] [longtitude : 8.25] [altitude: 500.0]";
        assert_eq!(place(misspelt), Some((47.5, 8.25, Some(500.0))));
        assert_eq!(place("F/2.8, SS 206, GPS (8.25, 47.5, 15), D 24.26m"), Some((47.5, 8.25, None)));
        assert_eq!(
            place("HOME(8.1,47.2) 2017.08.05\nGPS(8.25,47.5,19) BAROMETER:10.2"),
            Some((47.5, 8.25, None))
        );
        assert_eq!(date("2023-05-01 12:00:00,123,456"), parse_time("2023-05-01 12:00:00.123456"));
        assert_eq!(cue_start("00:01:02,033 --> 00:01:02,066"), Some(Span::from_ns(62_033_000_000)));
        assert_eq!(place("[latitude: x] [longitude: 1]"), None);
    }
}
