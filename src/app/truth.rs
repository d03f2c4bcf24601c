//! The truth of a flight from a CSV file, to compare with estimates.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::text;

/// Why a truth file could not be used.
#[derive(Debug, thiserror::Error)]
pub enum TruthError {
    /// The file could not be read.
    #[error("cannot read truth {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The header or a row is malformed.
    #[error("truth {}, line {line}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
}

/// The true state of a vehicle at a frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct TruthRow {
    /// Latitude of the reference point, degrees.
    pub lat_deg: f64,
    /// Longitude, degrees.
    pub lon_deg: f64,
    /// Heading, radians; `None` where not given.
    pub heading_rad: Option<f64>,
    /// Speed, m/s.
    pub speed_mps: Option<f64>,
    /// Yaw rate, rad/s.
    pub yaw_rate_radps: Option<f64>,
}

/// The truth of one vehicle.
#[derive(Clone, PartialEq, Debug)]
pub enum Truth {
    /// A row for each frame.
    Moving(BTreeMap<u32, TruthRow>),
    /// At rest all the time.
    AtRest(TruthRow),
}

impl Truth {
    /// Reads a CSV file with a header. It must have `lat_deg` and `lon_deg`; `heading_rad`, `speed_mps` and
    /// `yaw_rate_radps` are compared where present. With a column `frame` each row belongs to that frame; without, the
    /// file has one row: a surveyed point at rest.
    pub fn read(path: &Path) -> Result<Self, TruthError> {
        let content = std::fs::read_to_string(path)
            .map_err(|source| TruthError::Unreadable { path: path.to_owned(), source })?;
        Self::parse(&content).map_err(|(line, reason)| TruthError::Malformed {
            path: path.to_owned(),
            line,
            reason,
        })
    }

    /// As [`Self::read`], from the file's text; the error is the line and the reason.
    pub fn parse(content: &str) -> Result<Self, (usize, String)> {
        let mut lines = content.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
        let (_, header) = lines.next().ok_or((1, "it is empty".to_owned()))?;
        let names: Vec<&str> = header.split(',').map(str::trim).collect();
        let column = |name: &str| names.iter().position(|n| *n == name);
        let must = |name: &str| column(name).ok_or((1, format!("the column {name} is missing")));
        let (lat, lon) = (must("lat_deg")?, must("lon_deg")?);
        let (heading, speed, rate) = (column("heading_rad"), column("speed_mps"), column("yaw_rate_radps"));
        let frame = column("frame");
        let mut rows = BTreeMap::new();
        let mut alone = Vec::new();
        for (k, line) in lines {
            let fields: Vec<&str> = line.split(',').map(str::trim).collect();
            let number = |c: usize| {
                text::number(fields.get(c).copied().unwrap_or("")).map_err(|reason| (k + 1, reason))
            };
            let maybe = |c: Option<usize>| {
                c.filter(|c| fields.get(*c).is_some_and(|f| !f.is_empty())).map(number).transpose()
            };
            let row = TruthRow {
                lat_deg: number(lat)?,
                lon_deg: number(lon)?,
                heading_rad: maybe(heading)?,
                speed_mps: maybe(speed)?,
                yaw_rate_radps: maybe(rate)?,
            };
            match frame {
                Some(c) => {
                    let frame = number(c)?;
                    if !(0.0..=f64::from(u32::MAX)).contains(&frame) || frame.fract() != 0.0 {
                        return Err((k + 1, format!("{frame} is not a frame: frames count from 0")));
                    }
                    rows.insert(frame as u32, row);
                }
                None => alone.push(row),
            }
        }
        match (frame, alone.as_slice()) {
            (Some(_), _) if !rows.is_empty() => Ok(Self::Moving(rows)),
            (None, [one]) => {
                let still = TruthRow { speed_mps: Some(0.0), yaw_rate_radps: Some(0.0), ..*one };
                Ok(Self::AtRest(still))
            }
            (None, [_, _, ..]) => {
                Err((1, "the column frame is missing, and there is more than one row".to_owned()))
            }
            _ => Err((1, "it has a header but no rows".to_owned())),
        }
    }

    /// The truth at a frame.
    pub fn at(&self, frame: u32) -> Option<&TruthRow> {
        match self {
            Self::Moving(rows) => rows.get(&frame),
            Self::AtRest(row) => Some(row),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_belong_to_their_frames() {
        let text = "frame,time_ns,lat_deg,lon_deg,heading_rad,speed_mps,yaw_rate_radps\n\
                    3,5,30.1,-85.2,0.5,1.5,\n";
        let truth = Truth::parse(text).expect("well formed");
        let row = truth.at(3).expect("a row");
        assert_eq!((row.lat_deg, row.heading_rad, row.yaw_rate_radps), (30.1, Some(0.5), None));
        assert!(truth.at(4).is_none());
    }

    #[test]
    fn one_row_is_a_point_at_rest() {
        let truth = Truth::parse("lat_deg,lon_deg\n30.0,-85.0\n").expect("well formed");
        assert_eq!(truth.at(77).and_then(|row| row.speed_mps), Some(0.0));
    }

    #[test]
    fn errors_name_the_line() {
        assert_eq!(Truth::parse("frame,lat_deg\n").expect_err("no lon").0, 1);
        let error = Truth::parse("frame,lat_deg,lon_deg\n1,2,3\n2,x,3\n").expect_err("a word");
        assert_eq!(error, (3, "\"x\" is not a number".to_owned()));
        assert!(Truth::parse("").is_err());
        for row in ["nan,1,2", "1,nan,2", "1,2,inf", "-1,1,2", "1.5,1,2", "1e99,1,2"] {
            let error = Truth::parse(&format!("frame,lat_deg,lon_deg\n{row}\n")).expect_err(row);
            assert_eq!(error.0, 2, "{error:?}");
        }
    }
}
