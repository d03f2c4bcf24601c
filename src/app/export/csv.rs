//! CSV: one table for each kind of output, with the columns of the format contract.

use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};

use prost::Message;

use super::{ExportError, Exported, write_error};
use crate::app::refine::RefinedBeside;
use crate::io::mcap_read::{McapReader, RawMessage};
use crate::io::new_file::NewFile;
use crate::io::proto::host_time;
use crate::io::proto::windhover::{Datum, Detections, Marker, Ownship, TargetState};
use crate::io::records::topic;
use crate::text::{csv_field, csv_figure, finite};

/// The tables and their columns.
pub(super) const TABLES: [(&str, &str); 8] = [
    ("estimates.csv", ESTIMATE_COLUMNS),
    ("smoothed.csv", ESTIMATE_COLUMNS),
    ("paper.csv", ESTIMATE_COLUMNS),
    ("refined.csv", ESTIMATE_COLUMNS),
    ("detections.csv", DETECTION_COLUMNS),
    ("ownship.csv", OWNSHIP_COLUMNS),
    ("ownship_refined.csv", OWNSHIP_COLUMNS),
    ("datum.csv", DATUM_COLUMNS),
];
const ESTIMATE_COLUMNS: &str =
    "time_ns,frame,target,status,north_m,east_m,heading_rad,speed_mps,yaw_rate_radps,lat_deg,lon_deg";
const COVARIANCE_COLUMNS: &str =
    ",p_nn,p_ne,p_nh,p_nv,p_nw,p_ee,p_eh,p_ev,p_ew,p_hh,p_hv,p_hw,p_vv,p_vw,p_ww";
const COVARIANCE_TERMS: usize = 15;
const DETECTION_COLUMNS: &str =
    "time_ns,frame,kind,family,id,hamming,margin,center_u,center_v,u0,v0,u1,v1,u2,v2,u3,v3";
const OWNSHIP_COLUMNS: &str =
    "time_ns,frame,lat_deg,lon_deg,height_m,north_m,east_m,down_m,vn_mps,ve_mps,vd_mps,qw,qx,qy,qz";

const DATUM_COLUMNS: &str = "lat_deg,lon_deg,height_m";

/// A file being written, with its name for errors.
struct CsvTable {
    path: PathBuf,
    file: BufWriter<NewFile>,
    rows: u64,
}

impl CsvTable {
    fn create(out: &Path, name: &str, columns: &str) -> Result<Self, ExportError> {
        let path = out.join(name);
        let file = NewFile::create(&path).map_err(|source| write_error(&path, source))?;
        let mut table = Self { path, file: BufWriter::new(file), rows: 0 };
        table.row(columns)?;
        table.rows = 0;
        Ok(table)
    }

    fn row(&mut self, line: &str) -> Result<(), ExportError> {
        self.rows += 1;
        writeln!(self.file, "{line}").map_err(|source| write_error(&self.path, source))
    }

    fn close(self, files: &mut Vec<PathBuf>) -> Result<(), ExportError> {
        let whole = self.file.into_inner().map_err(|error| error.into_error()).and_then(NewFile::finish);
        whole.map_err(|source| write_error(&self.path, source))?;
        files.push(self.path);
        Ok(())
    }
}

pub(super) fn export(flight: &Path, mut reader: McapReader, out: &Path) -> Result<Exported, ExportError> {
    let mut beside = RefinedBeside::of(flight);
    let with_covariance = format!("{ESTIMATE_COLUMNS}{COVARIANCE_COLUMNS}");
    let mut estimates = CsvTable::create(out, "estimates.csv", &with_covariance)?;
    let mut smoothed = CsvTable::create(out, "smoothed.csv", &with_covariance)?;
    let mut refined = CsvTable::create(out, "refined.csv", &with_covariance)?;
    let mut paper = CsvTable::create(out, "paper.csv", ESTIMATE_COLUMNS)?;
    let mut detections = CsvTable::create(out, "detections.csv", DETECTION_COLUMNS)?;
    let mut ownship = CsvTable::create(out, "ownship.csv", OWNSHIP_COLUMNS)?;
    let mut ownship_refined = CsvTable::create(out, "ownship_refined.csv", OWNSHIP_COLUMNS)?;
    let mut ownship_rows: Vec<(i64, String)> = Vec::new();
    let mut datum: Option<Datum> = None;
    let mut damaged = Vec::new();
    for message in reader.by_ref().chain(beside.by_ref()) {
        let name = message.channel.topic.as_str();
        if name == topic::CAMERA_DETECTIONS {
            if let Some(seen) = decoded::<Detections>(&message, &mut damaged) {
                detection_rows(&seen).iter().try_for_each(|row| detections.row(row))?;
            }
        } else if name == topic::OWNSHIP {
            ownship_rows.extend(decoded::<Ownship>(&message, &mut damaged).map(|own| ownship_row(&own)));
        } else if name == topic::OWNSHIP_REFINED {
            if let Some(own) = decoded::<Ownship>(&message, &mut damaged) {
                ownship_refined.row(&ownship_row(&own).1)?;
            }
        } else if name == topic::DATUM {
            // A datum that moved replaces the earlier one.
            datum = decoded::<Datum>(&message, &mut damaged).or(datum);
        } else if let Some(kind) = name.strip_prefix("/target/").and_then(|rest| rest.rsplit('/').next()) {
            let (table, covariance) = match kind {
                "state" => (&mut estimates, true),
                "smoothed" => (&mut smoothed, true),
                "refined" => (&mut refined, true),
                "paper" => (&mut paper, false),
                _ => continue,
            };
            if let Some(state) = decoded::<TargetState>(&message, &mut damaged) {
                table.row(&state_row(&state, covariance))?;
            }
        }
    }
    // A frame is evaluated some time after its exposure, when later instants are already in the flight.
    ownship_rows.sort_by_key(|(time, _)| *time);
    ownship_rows.iter().try_for_each(|(_, row)| ownship.row(row))?;
    let mut warnings = reader.take_warnings();
    warnings.extend(beside.warning.take());
    warnings.extend(damaged);
    let mut exported = Exported { files: Vec::new(), warnings };
    let mut tables = vec![estimates, smoothed, paper, detections, ownship];
    // Few flights are refined, and an empty table would look like a refined flight.
    tables.extend([refined, ownship_refined].into_iter().filter(|table| table.rows > 0));
    if let Some(datum) = datum {
        let mut table = CsvTable::create(out, "datum.csv", DATUM_COLUMNS)?;
        table.row(&figures(&[(datum.lat_deg, 10), (datum.lon_deg, 10), (datum.height_m, 4)])[1..])?;
        tables.push(table);
    }
    // Empty tables would look like a flight in which nothing was seen.
    if tables.iter().any(|table| table.rows > 0) {
        tables.into_iter().try_for_each(|table| table.close(&mut exported.files))?;
    }
    Ok(exported)
}

/// `,1.25,-3.000000`: values with their decimals, empty where a value is not finite.
fn figures(figures: &[(f64, usize)]) -> String {
    let mut row = String::new();
    figures.iter().for_each(|(figure, decimals)| csv_figure(&mut row, *figure, *decimals));
    row
}

fn decoded<M: Message + Default>(message: &RawMessage, damaged: &mut Vec<String>) -> Option<M> {
    match M::decode(&message.data[..]) {
        Ok(m) => Some(m),
        Err(error) => {
            damaged.push(format!("a message on {} is damaged and skipped: {error}", message.channel.topic));
            None
        }
    }
}

fn state_row(s: &TargetState, with_covariance: bool) -> String {
    let status = s.status().as_str_name().to_ascii_lowercase();
    let time = host_time(s.timestamp.as_ref()).ns();
    let mut row = format!("{time},{},{},{status}", s.frame, csv_field(&s.target));
    if s.known {
        row += &figures(&[
            (s.north_m, 6),
            (s.east_m, 6),
            (s.heading_rad, 8),
            (s.speed_mps, 6),
            (s.yaw_rate_radps, 8),
            (s.lat_deg, 10),
            (s.lon_deg, 10),
        ]);
    } else {
        row += ",,,,,,,";
    }
    if with_covariance {
        for term in 0..COVARIANCE_TERMS {
            let known = s.covariance.get(term).copied().and_then(finite);
            row += &known.map_or(",".to_owned(), |p| format!(",{p:.9e}"));
        }
    }
    row
}

fn detection_rows(seen: &Detections) -> Vec<String> {
    let time = host_time(seen.timestamp.as_ref()).ns();
    seen.markers.iter().map(|marker| detection_row(time, seen.frame, marker)).collect()
}

fn detection_row(time: i64, frame: u32, m: &Marker) -> String {
    let (kind, family) = (csv_field(&m.kind), csv_field(&m.family));
    let mut row = format!("{time},{frame},{kind},{family},{},{}", m.id, m.hamming);
    row += &figures(&[(f64::from(m.margin), 2), (m.center_u, 4), (m.center_v, 4)]);
    for i in 0..8 {
        row += &m.corners.get(i).map_or(",".to_owned(), |c| figures(&[(*c, 4)]));
    }
    row
}

/// The row and its time; the frame number is empty where it belongs to no frame.
fn ownship_row(o: &Ownship) -> (i64, String) {
    let time = host_time(o.timestamp.as_ref()).ns();
    let frame = if o.between_frames { String::new() } else { o.frame.to_string() };
    let place = [(o.lat_deg, 10), (o.lon_deg, 10), (o.height_m, 4)];
    let local = [o.north_m, o.east_m, o.down_m, o.vn_mps, o.ve_mps, o.vd_mps].map(|figure| (figure, 6));
    let attitude = [o.qw, o.qx, o.qy, o.qz].map(|figure| (figure, 9));
    let row = format!("{time},{frame}{}{}{}", figures(&place), figures(&local), figures(&attitude));
    (time, row)
}
