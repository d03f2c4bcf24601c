//! CSV: one table a kind of output, columns as the contract of formats says.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use prost::Message;

use super::{ExportError, Exported, write_error};
use crate::io::mcap_read::{McapReader, RawMessage};
use crate::io::proto::host_time;
use crate::io::proto::windhover::{Datum, Detections, Marker, Ownship, TargetState};
use crate::io::records::topic;

const ESTIMATE_COLUMNS: &str =
    "time_ns,frame,target,status,north_m,east_m,heading_rad,speed_mps,yaw_rate_radps,lat_deg,lon_deg";
const COVARIANCE_COLUMNS: &str =
    ",p_nn,p_ne,p_nh,p_nv,p_nw,p_ee,p_eh,p_ev,p_ew,p_hh,p_hv,p_hw,p_vv,p_vw,p_ww";
const COVARIANCE_TERMS: usize = 15;
const DETECTION_COLUMNS: &str =
    "time_ns,frame,kind,family,id,hamming,margin,center_u,center_v,u0,v0,u1,v1,u2,v2,u3,v3";
const OWNSHIP_COLUMNS: &str =
    "time_ns,frame,lat_deg,lon_deg,height_m,north_m,east_m,down_m,vn_mps,ve_mps,vd_mps,qw,qx,qy,qz";

/// A file being written, remembered by name for errors.
struct CsvTable {
    path: PathBuf,
    file: BufWriter<File>,
    rows: u64,
}

impl CsvTable {
    fn create(out: &Path, name: &str, columns: &str) -> Result<Self, ExportError> {
        let path = out.join(name);
        let file = File::create(&path).map_err(|source| write_error(&path, source))?;
        let mut table = Self { path, file: BufWriter::new(file), rows: 0 };
        table.row(columns)?;
        table.rows = 0;
        Ok(table)
    }

    fn row(&mut self, line: &str) -> Result<(), ExportError> {
        self.rows += 1;
        writeln!(self.file, "{line}").map_err(|source| write_error(&self.path, source))
    }

    fn close(mut self, files: &mut Vec<PathBuf>) -> Result<u64, ExportError> {
        self.file.flush().map_err(|source| write_error(&self.path, source))?;
        files.push(self.path);
        Ok(self.rows)
    }
}

pub(super) fn export(mut reader: McapReader, out: &Path) -> Result<Exported, ExportError> {
    let with_covariance = format!("{ESTIMATE_COLUMNS}{COVARIANCE_COLUMNS}");
    let mut estimates = CsvTable::create(out, "estimates.csv", &with_covariance)?;
    let mut smoothed = CsvTable::create(out, "smoothed.csv", &with_covariance)?;
    let mut paper = CsvTable::create(out, "paper.csv", ESTIMATE_COLUMNS)?;
    let mut detections = CsvTable::create(out, "detections.csv", DETECTION_COLUMNS)?;
    let mut ownship = CsvTable::create(out, "ownship.csv", OWNSHIP_COLUMNS)?;
    let mut ownship_rows: Vec<(i64, String)> = Vec::new();
    let mut datum: Option<Datum> = None;
    let mut damaged = Vec::new();
    for message in reader.by_ref() {
        let name = message.channel.topic.as_str();
        if name == topic::CAMERA_DETECTIONS {
            if let Some(seen) = decoded::<Detections>(&message, &mut damaged) {
                detection_rows(&seen).iter().try_for_each(|row| detections.row(row))?;
            }
        } else if name == topic::OWNSHIP {
            ownship_rows.extend(decoded::<Ownship>(&message, &mut damaged).map(|own| ownship_row(&own)));
        } else if name == topic::DATUM {
            // One that moved holds.
            datum = decoded::<Datum>(&message, &mut damaged).or(datum);
        } else if let Some(kind) = name.strip_prefix("/target/").and_then(|rest| rest.rsplit('/').next()) {
            let (table, covariance) = match kind {
                "state" => (&mut estimates, true),
                "smoothed" => (&mut smoothed, true),
                "paper" => (&mut paper, false),
                _ => continue,
            };
            if let Some(state) = decoded::<TargetState>(&message, &mut damaged) {
                table.row(&state_row(&state, covariance))?;
            }
        }
    }
    // A frame is looked at some time after its exposure, when later instants are in the flight already.
    ownship_rows.sort_by_key(|(time, _)| *time);
    ownship_rows.iter().try_for_each(|(_, row)| ownship.row(row))?;
    let mut warnings = reader.take_warnings();
    warnings.extend(damaged);
    let mut exported = Exported { files: Vec::new(), warnings };
    let mut rows = 0;
    for table in [estimates, smoothed, paper, detections, ownship] {
        rows += table.close(&mut exported.files)?;
    }
    if let Some(datum) = datum {
        let mut table = CsvTable::create(out, "datum.csv", "lat_deg,lon_deg,height_m")?;
        table.row(&format!("{:.10},{:.10},{:.4}", datum.lat_deg, datum.lon_deg, datum.height_m))?;
        rows += table.close(&mut exported.files)?;
    }
    if rows == 0 {
        // Tables of nothing would look like a flight in which nothing was seen.
        for file in exported.files.drain(..) {
            std::fs::remove_file(&file).map_err(|source| write_error(&file, source))?;
        }
    }
    Ok(exported)
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
    let mut row = format!("{},{},{},{status}", host_time(s.timestamp.as_ref()).ns(), s.frame, s.target);
    if s.known {
        row += &format!(
            ",{:.6},{:.6},{:.8},{:.6},{:.8},{:.10},{:.10}",
            s.north_m, s.east_m, s.heading_rad, s.speed_mps, s.yaw_rate_radps, s.lat_deg, s.lon_deg
        );
    } else {
        row += ",,,,,,,";
    }
    if with_covariance {
        for term in 0..COVARIANCE_TERMS {
            row += &s.covariance.get(term).map_or(",".to_owned(), |p| format!(",{p:.9e}"));
        }
    }
    row
}

fn detection_rows(seen: &Detections) -> Vec<String> {
    let time = host_time(seen.timestamp.as_ref()).ns();
    seen.markers.iter().map(|marker| detection_row(time, seen.frame, marker)).collect()
}

fn detection_row(time: i64, frame: u32, m: &Marker) -> String {
    let mut row = format!(
        "{time},{frame},{},{},{},{},{:.2},{:.4},{:.4}",
        m.kind, m.family, m.id, m.hamming, m.margin, m.center_u, m.center_v
    );
    for i in 0..8 {
        row += &m.corners.get(i).map_or(",".to_owned(), |c| format!(",{c:.4}"));
    }
    row
}

/// The row, and its time; without a number where it belongs to no frame.
fn ownship_row(o: &Ownship) -> (i64, String) {
    let time = host_time(o.timestamp.as_ref()).ns();
    let frame = if o.between_frames { String::new() } else { o.frame.to_string() };
    let row = format!(
        "{time},{frame},{:.10},{:.10},{:.4},{:.6},{:.6},{:.6},{:.6},{:.6},{:.6},{:.9},{:.9},{:.9},{:.9}",
        o.lat_deg,
        o.lon_deg,
        o.height_m,
        o.north_m,
        o.east_m,
        o.down_m,
        o.vn_mps,
        o.ve_mps,
        o.vd_mps,
        o.qw,
        o.qx,
        o.qy,
        o.qz
    );
    (time, row)
}
