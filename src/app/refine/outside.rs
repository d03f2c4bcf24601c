//! External positions of the antenna: RTKLIB's solutions, GPX tracks, tables.
//!
//! | form | times | sigmas |
//! |---|---|---|
//! | RTKLIB's `.pos` (`lat lon height`) | GPST or UTC as its header states, as dates or as week and seconds | `sdn sde
//! sdu` |
//! | GPX (`trkpt lat lon`, `ele`, `time`) | UTC | [`DEFAULT_SIGMA_M`] |
//! | CSV with `time_ns` (host time) or `utc`, `lat_deg`, `lon_deg`, `height_m`; `sigma_m` or `sigma_n_m`, `sigma_e_m`,
//! `sigma_d_m` | as named | as given, else [`DEFAULT_SIGMA_M`] |

use std::path::{Path, PathBuf};

use crate::io::import::parse_time;
use crate::text;
use windhover_base::geo::Geodetic;
use windhover_base::time::{MonoTime, Span};
use windhover_refine::{OutsidePosition, Recording};

/// Sigma north, east, down, where a track gives none, m.
const DEFAULT_SIGMA_M: [f64; 3] = [0.5, 0.5, 1.0];
/// GPS time minus UTC, leap seconds (since 2017).
const GPS_LEAP_S: f64 = 18.0;
/// UTC of the start of GPS weeks, s since 1970.
const GPS_EPOCH_S: f64 = 315_964_800.0;

/// Why positions could not be read.
#[derive(Debug, thiserror::Error)]
pub enum OutsideError {
    /// The file could not be read.
    #[error("cannot read positions {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A line is malformed.
    #[error("positions {}, line {line}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// Its times are UTC, and the flight has no UTC.
    #[error("positions {}: their times are UTC, and no fix of the flight has a date", path.display())]
    NoUtc {
        /// The file.
        path: PathBuf,
    },
    /// No position is within the time of this flight.
    #[error("positions {}: none of its {count} positions is within the time of the flight", path.display())]
    Elsewhen {
        /// The file.
        path: PathBuf,
        /// Number of positions.
        count: usize,
    },
}

/// A position with its time, UTC or host time.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Row {
    /// Nanoseconds.
    t_ns: i64,
    is_host: bool,
    at: Geodetic,
    sigma_m: [f64; 3],
}

type Parsed = Result<Vec<Row>, (usize, String)>;

/// Reads positions and puts them into a recording.
///
/// # Errors
/// The file cannot be read or parsed, or no position is within the time of any of the recordings.
pub fn add_positions(path: &Path, recordings: &mut [Recording]) -> Result<(), OutsideError> {
    let text = std::fs::read_to_string(path)
        .map_err(|source| OutsideError::Unreadable { path: path.to_owned(), source })?;
    let extension = path.extension().map(|e| e.to_ascii_lowercase());
    let rows = match extension.as_ref().and_then(|e| e.to_str()) {
        Some("gpx") => gpx(&text),
        Some("csv") => csv(&text),
        _ => rtklib(&text),
    };
    let rows =
        rows.map_err(|(line, reason)| OutsideError::Malformed { path: path.to_owned(), line, reason })?;
    if rows.iter().any(|row| !row.is_host) && recordings.iter().all(|r| utc_ahead(r).is_none()) {
        return Err(OutsideError::NoUtc { path: path.to_owned() });
    }
    recordings.iter_mut().for_each(|recording| add_rows(&rows, recording));
    match recordings.iter().all(|recording| recording.positions.is_empty()) {
        true => Err(OutsideError::Elsewhen { path: path.to_owned(), count: rows.len() }),
        false => Ok(()),
    }
}

/// Puts the rows that are within its time into a recording.
fn add_rows(rows: &[Row], recording: &mut Recording) {
    let ahead = utc_ahead(recording);
    let known = rows.iter().filter(|row| row.is_host || ahead.is_some());
    let ahead = ahead.unwrap_or(Span::ZERO);
    let positions = known.map(|row| {
        let t = MonoTime::from_ns(row.t_ns);
        OutsidePosition { t: if row.is_host { t } else { t - ahead }, at: row.at, sigma_m: row.sigma_m }
    });
    let (from, to) = (recording.epochs.first(), recording.epochs.last());
    let within = |p: &OutsidePosition| {
        from.zip(to).is_some_and(|(from, to)| (from.t_valid..=to.t_valid).contains(&p.t))
    };
    let positions: Vec<OutsidePosition> = positions.filter(within).collect();
    recording.positions.extend(positions);
}

/// UTC less host time: the median over the epochs.
fn utc_ahead(recording: &Recording) -> Option<Span> {
    let differences = recording.epochs.iter().filter_map(|e| Some(e.value.utc?.unix_ns() - e.t_valid.ns()));
    let mut differences: Vec<i64> = differences.collect();
    differences.sort_unstable();
    differences.get(differences.len() / 2).copied().map(Span::from_ns)
}

/// RTKLIB's solution: `%` begins its header.
fn rtklib(text: &str) -> Parsed {
    let mut rows = Vec::new();
    let mut is_gpst = true;
    for (k, line) in text.lines().enumerate() {
        if line.starts_with('%') {
            is_gpst = if line.contains("UTC") { false } else { is_gpst };
            if line.contains("x-ecef") || line.contains("e-baseline") {
                return Err((k + 1, "write the solution as latitude, longitude, height".to_owned()));
            }
            continue;
        }
        let fields: Vec<&str> = line.split_whitespace().collect();
        if fields.is_empty() {
            continue;
        }
        rows.push(rtklib_row(&fields, is_gpst).map_err(|reason| (k + 1, reason))?);
    }
    Ok(rows)
}

fn rtklib_row(fields: &[&str], is_gpst: bool) -> Result<Row, String> {
    let [first, second, rest @ ..] = fields else { return Err("it has no time".to_owned()) };
    let seconds = if first.contains('/') || first.contains('-') {
        let date = first.replace('/', "-");
        let t = parse_time(&format!("{date} {second}")).ok_or("its time is invalid")?;
        t.ns()
    } else {
        let (week, in_week) = (text::number(first)?, text::number(second)?);
        ((GPS_EPOCH_S + week * 604_800.0 + in_week) * 1e9).round() as i64
    };
    let leap_ns = if is_gpst { (GPS_LEAP_S * 1e9) as i64 } else { 0 };
    let figure =
        |i: usize| rest.get(i).ok_or("it has too few columns".to_owned()).and_then(|f| text::number(f));
    let at = Geodetic { lat_deg: figure(0)?, lon_deg: figure(1)?, height_m: figure(2)? };
    let sigmas = [figure(5), figure(6), figure(7)];
    let sigma_m = std::array::from_fn(|i| match &sigmas[i] {
        Ok(sigma) if *sigma > 0.0 => *sigma,
        _ => DEFAULT_SIGMA_M[i],
    });
    Ok(Row { t_ns: seconds - leap_ns, is_host: false, at, sigma_m })
}

/// A GPX track: only its points, whatever else the file has.
fn gpx(text: &str) -> Parsed {
    let mut rows = Vec::new();
    for (at, begin) in text.match_indices("<trkpt") {
        let line = 1 + text[..at].matches('\n').count();
        let part = &text[at + begin.len()..];
        let point = part.split("</trkpt").next().unwrap_or(part);
        let attribute = |name: &str| -> Result<f64, String> {
            let after = point.split_once(&format!("{name}=")).ok_or(format!("a point without {name}"))?.1;
            let mut quoted = after.split(['"', '\'']);
            text::number(quoted.nth(1).unwrap_or(""))
        };
        let element = |name: &str| {
            let after = point.split_once(&format!("<{name}>"))?.1;
            after.split_once("</").map(|(inner, _)| inner.trim())
        };
        let row = || -> Result<Row, String> {
            let time = element("time").and_then(parse_time).ok_or("a point without a time")?;
            let height_m = text::number(element("ele").ok_or("a point without ele")?)?;
            let at = Geodetic { lat_deg: attribute("lat")?, lon_deg: attribute("lon")?, height_m };
            Ok(Row { t_ns: time.ns(), is_host: false, at, sigma_m: DEFAULT_SIGMA_M })
        };
        rows.push(row().map_err(|reason| (line, reason))?);
    }
    if rows.is_empty() {
        return Err((1, "it has no track".to_owned()));
    }
    Ok(rows)
}

fn csv(text: &str) -> Parsed {
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let (_, header) = lines.next().ok_or((1, "it is empty".to_owned()))?;
    let names: Vec<&str> = header.split(',').map(str::trim).collect();
    let column = |name: &str| names.iter().position(|n| *n == name);
    let must = |name: &str| column(name).ok_or((1, format!("the column {name} is missing")));
    let (lat, lon, height) = (must("lat_deg")?, must("lon_deg")?, must("height_m")?);
    let (host, utc) = (column("time_ns"), column("utc"));
    if host.is_none() && utc.is_none() {
        return Err((1, "a column time_ns or utc is missing".to_owned()));
    }
    let sigmas = ["sigma_n_m", "sigma_e_m", "sigma_d_m"].map(|name| column(name).or(column("sigma_m")));
    let mut rows = Vec::new();
    for (k, line) in lines {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let field = |c: usize| fields.get(c).copied().unwrap_or("");
        let row = || -> Result<Row, String> {
            let number = |c: usize| text::number(field(c));
            let (t_ns, is_host) = match (host, utc) {
                (Some(c), _) => {
                    (field(c).parse().map_err(|_| format!("{:?} is not a time_ns", field(c)))?, true)
                }
                (None, Some(c)) => {
                    (parse_time(field(c)).ok_or(format!("{:?} is not a time", field(c)))?.ns(), false)
                }
                (None, None) => return Err("it has no time".to_owned()),
            };
            let at = Geodetic { lat_deg: number(lat)?, lon_deg: number(lon)?, height_m: number(height)? };
            let mut sigma_m = DEFAULT_SIGMA_M;
            for (sigma, c) in sigma_m.iter_mut().zip(sigmas) {
                if let Some(c) = c {
                    *sigma = number(c)
                        .and_then(|s| if s > 0.0 { Ok(s) } else { Err(format!("{s} is not a sigma")) })?;
                }
            }
            Ok(Row { t_ns, is_host, at, sigma_m })
        };
        rows.push(row().map_err(|reason| (k + 1, reason))?);
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 18 November 2026, 15:04:05.2 UTC.
    const UTC_NS: i64 = 1_795_014_245_200_000_000;

    #[test]
    fn solutions_of_rtklib_tell_place_time_and_sigmas() {
        let text = "% program : rnx2rtkp\n%  GPST  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)\n\
                    2026/11/18 15:04:23.200   30.069604785  -85.575391587    26.0000   1  12   0.0100   0.0200   0.0300\n\
                    2445 313463.200   30.0  -85.0    26.0   2  12   0.0   0.0   0.0\n";
        let rows = rtklib(text).expect("well formed");
        assert_eq!(rows[0].t_ns, UTC_NS);
        assert_eq!((rows[0].at.lat_deg, rows[0].sigma_m), (30.069_604_785, [0.01, 0.02, 0.03]));
        assert_eq!((rows[1].t_ns, rows[1].sigma_m), (UTC_NS, DEFAULT_SIGMA_M));
        let utc = "%  UTC  latitude(deg)\n2026/11/18 15:04:05.200 30 -85 26 1 12 0.1 0.1 0.1\n";
        assert_eq!(rtklib(utc).expect("well formed")[0].t_ns, UTC_NS);
        assert_eq!(rtklib("%  GPST  x-ecef(m)\n").expect_err("not a place").0, 1);
        assert_eq!(rtklib("2026/11/18 15:04:05 30 x 26\n").expect_err("no figure").0, 1);
    }

    #[test]
    fn tracks_and_tables_are_read_and_errors_name_the_line() {
        let track = "<gpx><trk><trkseg>\n<trkpt lat=\"30.5\" lon='-85.5'><ele>26</ele>\
                     <time>2026-11-18T15:04:05.2Z</time></trkpt>\n</trkseg></trk></gpx>";
        let rows = gpx(track).expect("well formed");
        assert_eq!((rows[0].t_ns, rows[0].at.lon_deg, rows[0].at.height_m), (UTC_NS, -85.5, 26.0));
        assert!(gpx("<gpx></gpx>").is_err());
        let rows = csv("utc,lat_deg,lon_deg,height_m,sigma_m\n2026-11-18T15:04:05.2Z,30,-85,26,0.02\n");
        let rows = rows.expect("well formed");
        assert_eq!((rows[0].t_ns, rows[0].is_host, rows[0].sigma_m), (UTC_NS, false, [0.02; 3]));
        let wrong = csv("time_ns,lat_deg,lon_deg,height_m\n5,30,-85,26\n6,x,-85,26\n");
        assert_eq!(wrong.expect_err("a word").0, 3);
        assert!(csv("lat_deg,lon_deg,height_m\n").expect_err("no time").1.contains("time_ns"));
    }
}
