//! Tables of samples: rates and forces, or attitudes; a row for each sample, columns by the names in the header.

use std::path::Path;

use nalgebra::Vector3;

use super::{ImportError, parse_time};
use crate::text::number;
use windhover_base::geo::Tilt;
use windhover_base::msg::{AttitudeSample, InertialSample};
use windhover_base::time::MonoTime;

/// Samples with their times, in order of time, and the numbers of the rows that could not be read, from 1.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Samples<T> {
    /// Time and sample.
    pub samples: Vec<(MonoTime, T)>,
    /// Rows left out.
    pub unread: Vec<usize>,
}

/// Columns of rates, degrees a second, and of specific forces, m/s².
const RATES: [&str; 3] = ["gyro_x_dps", "gyro_y_dps", "gyro_z_dps"];
const FORCES: [&str; 3] = ["acc_x_mps2", "acc_y_mps2", "acc_z_mps2"];

/// Reads `time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,acc_x_mps2,acc_y_mps2,acc_z_mps2`: columns in any order, others
/// allowed; the three rates or the three forces may be absent.
pub fn read_inertial(path: &Path) -> Result<Samples<InertialSample>, ImportError> {
    read(path, |header, fields| {
        let three = |names: [&str; 3]| {
            let figures = names.map(|name| figure(header, fields, name));
            figures.iter().all(Option::is_some).then(|| Vector3::from(figures.map(Option::unwrap_or_default)))
        };
        let rate_rps = three(RATES).map(|dps| dps.map(f64::to_radians));
        let force_mps2 = three(FORCES);
        (rate_rps.is_some() || force_mps2.is_some()).then_some(InertialSample { rate_rps, force_mps2 })
    })
}

/// Reads `time_s,heading_deg,pitch_deg,roll_deg`: heading true, nose up and right side down positive; columns in any
/// order, others allowed; the heading or both other angles may be absent.
pub fn read_attitude(path: &Path) -> Result<Samples<AttitudeSample>, ImportError> {
    read(path, |header, fields| {
        let angle = |name| figure(header, fields, name).map(f64::to_radians);
        let tilt = angle("pitch_deg").zip(angle("roll_deg")).map(|(pitch, roll)| Tilt { pitch, roll });
        let heading = angle("heading_deg");
        (heading.is_some() || tilt.is_some()).then_some(AttitudeSample {
            heading,
            heading_is_true: true,
            tilt,
        })
    })
}

/// The value in a column; `None` where it is empty or the column is absent.
fn figure(header: &[&str], fields: &[&str], name: &str) -> Option<f64> {
    let at = header.iter().position(|column| *column == name)?;
    number(fields.get(at)?).ok()
}

fn read<T>(path: &Path, sample: impl Fn(&[&str], &[&str]) -> Option<T>) -> Result<Samples<T>, ImportError> {
    let text = std::fs::read_to_string(path).map_err(|e| ImportError::io(path, e))?;
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let header: Vec<&str> = lines.next().map_or(Vec::new(), |(_, line)| split(line));
    let Some(time) = header.iter().position(|column| *column == "time_s") else {
        return Err(ImportError::line(path, 1, "the header has no column time_s"));
    };
    let mut table = Samples { samples: Vec::new(), unread: Vec::new() };
    for (index, line) in lines {
        let fields = split(line);
        let t = fields.get(time).and_then(|text| parse_time(text));
        match t.zip(sample(&header, &fields)) {
            Some(row) => table.samples.push(row),
            None => table.unread.push(index + 1),
        }
    }
    if table.samples.is_empty() {
        let line = table.unread.first().copied().unwrap_or(1);
        let reason = format!("no row has a time and a sample; its header is {}", header.join(","));
        return Err(ImportError::line(path, line, reason));
    }
    table.samples.sort_by_key(|(t, _)| *t);
    Ok(table)
}

fn split(line: &str) -> Vec<&str> {
    line.split(',').map(str::trim).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().expect("a scratch file");
        std::fs::write(file.path(), text).expect("written");
        file
    }

    #[test]
    fn columns_are_found_by_their_names() {
        let text =
            "acc_z_mps2,time_s,note,acc_x_mps2,acc_y_mps2\n-9.8,2.5,up,0.1,0.2\n-9.7,2.4,,0,0\n,2.6,,0,0\n";
        let read = read_inertial(table(text).path()).expect("it reads");
        assert_eq!(read.unread, [4]);
        assert_eq!(read.samples.len(), 2);
        let (t, sample) = read.samples[1];
        assert_eq!(t, MonoTime::from_ns(2_500_000_000));
        let force = Some(Vector3::new(0.1, 0.2, -9.8));
        assert_eq!(sample, InertialSample { rate_rps: None, force_mps2: force });

        let text = "time_s,heading_deg,pitch_deg,roll_deg\n1,90,180,\n2,90,10,-20\n";
        let read = read_attitude(table(text).path()).expect("it reads");
        assert!(read.samples[0].1.tilt.is_none() && read.samples[0].1.heading_is_true);
        let tilt = read.samples[1].1.tilt.expect("both are there");
        assert!(
            (tilt.pitch.to_degrees() - 10.0).abs() < 1e-9 && (tilt.roll.to_degrees() + 20.0).abs() < 1e-9
        );
    }

    #[test]
    fn a_table_of_something_else_is_named() {
        let error = read_inertial(table("a,b\n1,2\n").path()).expect_err("no time").to_string();
        assert!(error.contains("time_s"), "{error}");
        let error = read_inertial(table("time_s,x\n1,2\n").path()).expect_err("no samples").to_string();
        assert!(error.contains(":2:") && error.contains("time_s,x"), "{error}");
    }
}
