//! KML with `gx:Track`, for Google Earth's time slider.

use std::fmt::Write as _;
use std::path::Path;

use super::tracks::{self, Point};
use super::{ExportError, Exported, write_error};
use crate::io::mcap_read::McapReader;
use crate::io::new_file::NewFile;
use crate::plot::MADE_BY;
use crate::text::xml;
use windhover_base::time::UtcTime;

/// Its file, and the generator's name near the start of the file.
pub(super) const FILE: (&str, &str) = ("flight.kml", MADE_BY);

pub(super) fn export(mut reader: McapReader, out: &Path) -> Result<Exported, ExportError> {
    let tracks = tracks::read(&mut reader);
    let mut exported = Exported { files: Vec::new(), warnings: reader.take_warnings() };
    if tracks.is_empty() {
        return Ok(exported);
    }
    let mut text = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<!-- {MADE_BY} -->\n\
         <kml xmlns=\"http://www.opengis.net/kml/2.2\" xmlns:gx=\"http://www.google.com/kml/ext/2.2\">\n\
         <Document>\n<name>windhover flight</name>\n"
    );
    for (name, points) in &tracks {
        placemark(&mut text, name, points);
    }
    text += "</Document>\n</kml>\n";
    let path = out.join(FILE.0);
    NewFile::write(&path, text.as_bytes()).map_err(|source| write_error(&path, source))?;
    exported.files.push(path);
    Ok(exported)
}

fn placemark(text: &mut String, name: &str, points: &[Point]) {
    let (colour, mode) = match points.first().and_then(|p| p.height_m) {
        Some(_) => ("ffd09030", "absolute"),
        None => ("ff3060e0", "clampToGround"),
    };
    // Writing into a String cannot fail.
    let _ = write!(
        text,
        "<Placemark>\n<name>{}</name>\n<Style><LineStyle><color>{colour}</color><width>3</width>\
         </LineStyle></Style>\n<gx:Track>\n<altitudeMode>{mode}</altitudeMode>\n",
        xml(name)
    );
    for p in points {
        let _ = writeln!(text, "<when>{}</when>", UtcTime::from_unix_ns(p.t.ns()));
    }
    for p in points {
        let _ = writeln!(
            text,
            "<gx:coord>{:.9} {:.9} {:.3}</gx:coord>",
            p.lon_deg,
            p.lat_deg,
            p.height_m.unwrap_or(0.0)
        );
    }
    for p in points {
        let _ = writeln!(text, "<gx:angles>{:.2} 0 0</gx:angles>", p.heading_deg);
    }
    *text += "</gx:Track>\n</Placemark>\n";
}
