//! GeoJSON (RFC 7946): a line for each track, and its positions once a second with their properties.

use std::path::Path;

use serde_json::{Value, json};

use super::tracks::{self, Point};
use super::{ExportError, Exported, write_error};
use crate::io::mcap_read::McapReader;
use crate::io::new_file::NewFile;
use crate::plot::MADE_BY;
use windhover_base::time::{Span, UtcTime};

/// Its file, and the generator's name near the start of the file.
pub(super) const FILE: (&str, &str) = ("flight.geojson", MADE_BY);

/// Time between two positions; the line has all of them.
const POINT_PERIOD: Span = Span::from_ns(1_000_000_000);

pub(super) fn export(mut reader: McapReader, out: &Path) -> Result<Exported, ExportError> {
    let tracks = tracks::read(&mut reader);
    let mut features = Vec::new();
    for (name, points) in &tracks {
        features.push(line(name, points));
        let mut last = None;
        for point in points {
            if last.is_none_or(|t| point.t - t >= POINT_PERIOD) {
                features.push(position(name, point));
                last = Some(point.t);
            }
        }
    }
    let mut exported = Exported { files: Vec::new(), warnings: reader.take_warnings() };
    if features.is_empty() {
        return Ok(exported);
    }
    let path = out.join(FILE.0);
    // The generator comes first: other members may follow type and features (RFC 7946, 6.1).
    let features = Value::Array(features);
    let text = format!(
        "{{\n\"type\": \"FeatureCollection\",\n\"generator\": \"{MADE_BY}\",\n\"features\": {features:#}\n}}\n"
    );
    NewFile::write(&path, text.as_bytes()).map_err(|source| write_error(&path, source))?;
    exported.files.push(path);
    Ok(exported)
}

/// Rounds to decimals that hold a centimetre, not the noise below it.
fn rounded(x: f64, decimals: i32) -> f64 {
    let scale = 10_f64.powi(decimals);
    (x * scale).round() / scale
}

fn coordinates(p: &Point) -> Value {
    let (lon, lat) = (rounded(p.lon_deg, 9), rounded(p.lat_deg, 9));
    p.height_m.map_or(json!([lon, lat]), |h| json!([lon, lat, rounded(h, 3)]))
}

fn line(name: &str, points: &[Point]) -> Value {
    let times: Vec<String> = points.iter().map(|p| UtcTime::from_unix_ns(p.t.ns()).to_string()).collect();
    json!({
        "type": "Feature",
        "properties": { "name": name, "kind": "track", "coordTimes": times },
        "geometry": { "type": "LineString", "coordinates": points.iter().map(coordinates).collect::<Vec<_>>() },
    })
}

fn position(name: &str, p: &Point) -> Value {
    json!({
        "type": "Feature",
        "properties": {
            "name": name,
            "kind": "position",
            "time": UtcTime::from_unix_ns(p.t.ns()).to_string(),
            "heading_deg": rounded(p.heading_deg, 2),
            "speed_mps": p.speed_mps.map(|v| rounded(v, 3)),
            "yaw_rate_dps": p.yaw_rate_dps.map(|w| rounded(w, 3)),
            "sigma_m": p.sigma_m.map(|s| rounded(s, 3)),
        },
        "geometry": { "type": "Point", "coordinates": coordinates(p) },
    })
}
