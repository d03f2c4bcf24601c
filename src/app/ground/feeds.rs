//! The vehicles for other programs: GeoJSON, KML, NMEA.

use serde_json::{Value, json};

use super::view::{Vehicle, nmea_time};
use crate::io::proto::host_time;
use crate::text::{finite, xml};

/// Trail points in KML and GeoJSON; more would only slow a viewer down.
const POINTS: usize = 2_000;
/// Knots in a metre a second.
const KNOTS: f64 = 3_600.0 / 1_852.0;

/// Separators of GSA's twelve satellites and its PDOP, which stay empty, and the one after.
const UNNAMED: usize = 14;

fn thinned(vehicle: &Vehicle) -> impl Iterator<Item = (f64, f64)> + '_ {
    let every = vehicle.trail.len().div_ceil(POINTS).max(1);
    vehicle.trail.iter().step_by(every).map(|(_, lat, lon)| (*lat, *lon))
}

fn heading_deg(vehicle: &Vehicle) -> f64 {
    vehicle.state.heading_rad.to_degrees().rem_euclid(360.0)
}

/// One-sigma of north and east, metres; `None` without a covariance.
fn sigmas_m(vehicle: &Vehicle) -> Option<(f64, f64)> {
    let p = &vehicle.state.covariance;
    Some((p.first()?.max(0.0).sqrt(), p.get(5)?.max(0.0).sqrt()))
}

/// Every vehicle as a point, and its trail as a line.
pub fn geojson(vehicles: &[Vehicle]) -> String {
    let mut features = Vec::new();
    for vehicle in vehicles {
        let s = &vehicle.state;
        let (sigma_n, sigma_e) =
            sigmas_m(vehicle).map_or((Value::Null, Value::Null), |(n, e)| (json!(n), json!(e)));
        // A state that is not current has no position (RFC 7946, 3.2: an unlocated feature); the trail ends at its last
        // one.
        let here = json!({"type": "Point", "coordinates": [s.lon_deg, s.lat_deg]});
        let geometry = if vehicle.is_current() { here } else { Value::Null };
        features.push(json!({"type": "Feature", "id": format!("{}/{}", vehicle.payload, vehicle.target),
            "geometry": geometry,
            "properties": {"payload": vehicle.payload, "target": vehicle.target,
                "status": vehicle.status, "age_s": vehicle.age.s(),
                "utc": vehicle.utc.map(|utc| utc.to_string()),
                "time_ms": vehicle.utc.map(|utc| utc.unix_ns() / 1_000_000),
                "host_time_ms": host_time(s.timestamp.as_ref()).ns() / 1_000_000,
                "heading_deg": heading_deg(vehicle), "speed_mps": s.speed_mps,
                "yaw_rate_radps": s.yaw_rate_radps, "sigma_north_m": sigma_n, "sigma_east_m": sigma_e}}));
        let line: Vec<Value> = thinned(vehicle).map(|(lat, lon)| json!([lon, lat])).collect();
        if line.len() > 1 {
            features.push(json!({"type": "Feature", "geometry": {"type": "LineString", "coordinates": line},
                "properties": {"payload": vehicle.payload, "target": vehicle.target, "kind": "trail"}}));
        }
    }
    json!({"type": "FeatureCollection", "features": features}).to_string()
}

/// A network link that fetches [`kml`] every second.
pub fn network_link(url: &str) -> String {
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<kml xmlns=\"http://www.opengis.net/kml/2.2\">\
         <NetworkLink><name>windhover</name><Link><href>{}</href><refreshMode>onInterval</refreshMode>\
         <refreshInterval>1</refreshInterval></Link></NetworkLink></kml>\n",
        xml(url)
    )
}

/// Every vehicle as a placemark that is turned to its heading, and its trail.
pub fn kml(vehicles: &[Vehicle]) -> String {
    let mut out = String::from(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<kml xmlns=\"http://www.opengis.net/kml/2.2\"><Document>\
         <name>windhover</name>",
    );
    for vehicle in vehicles {
        let name = xml(&format!("{} ({})", vehicle.target, vehicle.payload));
        out += &if vehicle.is_current() { placemark(vehicle, &name) } else { last_known(vehicle, &name) };
        let line: Vec<String> = thinned(vehicle).map(|(lat, lon)| format!("{lon:.9},{lat:.9},0")).collect();
        if line.len() > 1 {
            out += &format!(
                "<Placemark><name>{name} trail</name><Style><LineStyle><color>ff0f48d9</color><width>2</width>\
                 </LineStyle></Style><LineString><tessellate>1</tessellate><coordinates>{}</coordinates>\
                 </LineString></Placemark>",
                line.join(" ")
            );
        }
    }
    out + "</Document></kml>\n"
}

/// A vehicle's current position, turned to its heading; a predicted one is orange.
fn placemark(vehicle: &Vehicle, name: &str) -> String {
    let (s, heading) = (&vehicle.state, heading_deg(vehicle));
    let colour = if vehicle.status == "tracking" { "ff0f48d9" } else { "ff00a5ff" };
    format!(
        "<Placemark><name>{name}</name><description>{}, {:.1} s old{}: {:.2} m/s, {heading:.0}°</description><Style>\
         <IconStyle><color>{colour}</color><heading>{heading:.1}</heading></IconStyle></Style><Point><coordinates>\
         {:.9},{:.9},0</coordinates></Point></Placemark>",
        vehicle.status,
        vehicle.age.s(),
        vehicle.utc.map_or(String::new(), |utc| format!(", at {utc}")),
        s.speed_mps,
        s.lon_deg,
        s.lat_deg
    )
}

/// A lost vehicle: in the list with its age, and not on the map; its trail ends at its last position.
fn last_known(vehicle: &Vehicle, name: &str) -> String {
    format!(
        "<Placemark><name>{name}: {}, last known {:.0} s ago</name></Placemark>",
        vehicle.status,
        vehicle.age.s()
    )
}

/// A sentence with its checksum.
fn sentence(body: &str) -> String {
    let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    format!("${body}*{checksum:02X}\r\n")
}

/// `ddmm.mmmmmm,N`: degrees (of `width` digits), minutes, hemisphere.
fn angle(degrees: f64, width: usize, hemispheres: [char; 2]) -> String {
    // The last digit is rounded first, so that minutes never read 60.
    let micro_minutes = (degrees.abs() * 60e6).round() as u64;
    let (whole, rest) = (micro_minutes / 60_000_000, micro_minutes % 60_000_000);
    let hemisphere = hemispheres[usize::from(degrees < 0.0)];
    format!("{whole:0width$}{:02}.{:06},{hemisphere}", rest / 1_000_000, rest % 1_000_000)
}

/// How NMEA 0183 qualifies a position: validity in RMC, mode, and quality in GGA.
///
/// It is a fix (A, quality 1) where the vehicle is tracked and the helicopter's receiver, from which the position
/// derives, has a three-dimensional fix. Every other known position is "estimated" (V, mode E, quality 6).
fn quality(vehicle: &Vehicle) -> (char, char, u8) {
    let placed = vehicle.receiver.is_some_and(|receiver| receiver.fix == 3);
    if placed && vehicle.status == "tracking" { ('A', 'A', 1) } else { ('V', 'E', 6) }
}

/// A value with its decimals, or nothing.
fn maybe(figure: Option<f64>, decimals: usize) -> String {
    figure.and_then(finite).map_or(String::new(), |figure| format!("{figure:.decimals$}"))
}

/// RMC, GGA, GSA and GST of a vehicle. A lost one has neither position nor time. Time and date stay empty where UTC is
/// not known. Satellites and dilution are those of the helicopter's receiver; the altitude is that of the ground under
/// the vehicle above mean sea level, by the receiver's geoid, and empty where the receiver does not report it;
/// one-sigmas (GST) are the vehicle's own.
pub fn nmea(vehicle: &Vehicle) -> String {
    let s = &vehicle.state;
    if !vehicle.is_current() {
        return sentence("GPRMC,,V,,,,,,,,,,N")
            + &sentence("GPGGA,,,,,,0,,,,M,,M,,")
            + &sentence(&format!("GPGSA,A,1{},", ",".repeat(UNNAMED)));
    }
    let (time, date) = nmea_time(vehicle.utc);
    let (lat, lon) = (angle(s.lat_deg, 2, ['N', 'S']), angle(s.lon_deg, 3, ['E', 'W']));
    // Course over ground: for a vehicle that reverses, its direction of motion.
    let course = if s.speed_mps < 0.0 { heading_deg(vehicle) + 180.0 } else { heading_deg(vehicle) } % 360.0;
    let knots = s.speed_mps.abs() * KNOTS;
    let (valid, mode, quality) = quality(vehicle);
    let (receiver, geoid_m) = (vehicle.receiver, vehicle.receiver.and_then(|receiver| receiver.geoid_m));
    let sats = receiver.map_or(String::new(), |receiver| format!("{:02}", receiver.sats.min(99)));
    let hdop = maybe(receiver.and_then(|receiver| receiver.hdop), 1);
    let (alt_msl_m, separation_m) = (maybe(geoid_m.map(|geoid| s.height_m - geoid), 1), maybe(geoid_m, 1));
    let dimensions = match (quality, geoid_m) {
        (1, Some(_)) => 3,
        (1, None) => 2,
        _ => 1,
    };
    let rmc = sentence(&format!("GPRMC,{time},{valid},{lat},{lon},{knots:.2},{course:.1},{date},,,{mode}"));
    let gga = sentence(&format!(
        "GPGGA,{time},{lat},{lon},{quality},{sats},{hdop},{alt_msl_m},M,{separation_m},M,,"
    ));
    // The link does not carry which satellites they are.
    let gsa = sentence(&format!("GPGSA,A,{dimensions}{}{hdop},", ",".repeat(UNNAMED)));
    let gst = sigmas_m(vehicle).map_or(String::new(), |(n, e)| {
        sentence(&format!("GPGST,{time},,,,,{},{},", maybe(Some(n), 2), maybe(Some(e), 2)))
    });
    rmc + &gga + &gsa + &gst
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::ground::view::Receiver;
    use crate::io::proto::{timestamp, windhover as wh};
    use windhover_base::time::{MonoTime, Span, UtcTime};

    fn vehicle() -> Vehicle {
        let t = MonoTime::from_ns(1_795_046_445_250_000_000);
        Vehicle {
            payload: "a<b".into(),
            target: "ugv".into(),
            state: wh::TargetState {
                timestamp: Some(timestamp(t)),
                target: "ugv".into(),
                known: true,
                heading_rad: -std::f64::consts::FRAC_PI_2,
                speed_mps: 2.0,
                lat_deg: 30.999_999_999_9,
                lon_deg: -85.5,
                height_m: 5.5,
                covariance: [vec![0.25, 0.0, 0.0, 0.0, 0.0, 0.09], vec![0.0; 9]].concat(),
                ..Default::default()
            },
            status: "tracking",
            age: Span::from_ms(70.0),
            utc: Some(UtcTime::from_unix_ns(t.ns())),
            receiver: Some(Receiver { fix: 3, sats: 9, hdop: Some(0.94), geoid_m: Some(-27.5) }),
            trail: vec![(t, 30.0, -85.0), (t, 30.1, -85.1)],
        }
    }

    #[test]
    fn sentences_are_read_back_by_a_parser() {
        let text = nmea(&vehicle());
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "$GPRMC,000045.25,A,3100.000000,N,08530.000000,W,3.89,270.0,191126,,,A*7D");
        assert_eq!((lines[2].split(',').count(), lines.len()), (18, 4), "{text}");
        assert!(lines[2].starts_with("$GPGSA,A,3,,,") && lines[2].contains(",0.9,*"), "{text}");
        for line in lines.into_iter().filter(|line| !line.contains("GSA")) {
            let parsed = nmea::parse_str(line).expect("a sentence");
            match parsed {
                nmea::ParseResult::RMC(rmc) => assert_eq!((rmc.lat, rmc.lon), (Some(31.0), Some(-85.5))),
                nmea::ParseResult::GGA(gga) => {
                    assert_eq!(
                        (gga.latitude, gga.altitude, gga.geoid_separation),
                        (Some(31.0), Some(33.0), Some(-27.5))
                    );
                    assert_eq!((gga.fix_satellites, gga.hdop), (Some(9), Some(0.9)));
                }
                nmea::ParseResult::GST(gst) => assert_eq!((gst.lat_sd, gst.long_sd), (Some(0.5), Some(0.3))),
                other => panic!("{other:?}"),
            }
        }
        // A vehicle's position is no better than the fix of the helicopter's receiver.
        let unsure = |receiver| nmea(&Vehicle { receiver, ..vehicle() });
        let said = vehicle().receiver;
        let two = unsure(said.map(|said| Receiver { fix: 2, ..said }));
        assert!(
            two.contains(",V,3100.000000,N,")
                && two.contains(",W,6,09,0.9,33.0,M,-27.5,M")
                && two.contains("GPGSA,A,1,"),
            "{two}"
        );
        assert!(unsure(None).contains(",W,6,,,,M,,M"), "{}", unsure(None));
        let flat = unsure(said.map(|said| Receiver { geoid_m: None, ..said }));
        assert!(flat.contains(",W,1,09,0.9,,M,,M") && flat.contains("GPGSA,A,2,"), "{flat}");
    }

    #[test]
    fn what_is_predicted_is_no_fix_and_what_is_lost_no_position() {
        let coasting = Vehicle { status: "coasting", ..vehicle() };
        let text = nmea(&coasting);
        assert!(
            text.starts_with("$GPRMC,000045.25,V,3100.000000,N,08530.000000,W,3.89,270.0,191126,,,E*"),
            "{text}"
        );
        assert!(text.contains("GPGGA,000045.25,3100.000000,N,08530.000000,W,6,"), "{text}");
        let lost = Vehicle { status: "lost", age: Span::from_s(35.2), ..vehicle() };
        assert!(
            nmea(&lost).starts_with("$GPRMC,,V,,,,,,,,,,N*53\r\n$GPGGA,,,,,,0,,,,M,,M,,*66\r\n$GPGSA,A,1,")
        );
        let parsed: Value = serde_json::from_str(&geojson(std::slice::from_ref(&lost))).expect("JSON");
        assert_eq!(parsed["features"][0]["geometry"], Value::Null);
        assert_eq!(parsed["features"][0]["properties"]["status"], json!("lost"));
        assert_eq!(parsed["features"][0]["properties"]["age_s"], json!(35.2));
        let kml = kml(&[lost]);
        assert!(!kml.contains("<Point>") && kml.contains("ugv (a&lt;b): lost, last known 35 s ago"), "{kml}");
    }

    #[test]
    fn utc_is_sent_where_the_receiver_reported_it_and_nowhere_else() {
        let unset = Vehicle { utc: None, ..vehicle() };
        assert!(nmea(&unset).starts_with("$GPRMC,,A,3100.000000,N,08530.000000,W,3.89,270.0,,,,A*"));
        let parsed: Value = serde_json::from_str(&geojson(&[unset])).expect("JSON");
        let properties = &parsed["features"][0]["properties"];
        assert_eq!((&properties["utc"], &properties["time_ms"]), (&Value::Null, &Value::Null));
        assert_eq!(properties["host_time_ms"], json!(1_795_046_445_250_i64));
        let parsed: Value = serde_json::from_str(&geojson(&[vehicle()])).expect("JSON");
        assert_eq!(parsed["features"][0]["properties"]["utc"], json!("2026-11-19T00:00:45.250Z"));
    }

    #[test]
    fn geojson_and_kml_hold_point_and_trail() {
        let parsed: Value = serde_json::from_str(&geojson(&[vehicle()])).expect("JSON");
        assert_eq!(parsed["features"][0]["geometry"]["coordinates"][0], json!(-85.5));
        assert_eq!(parsed["features"][1]["geometry"]["coordinates"].as_array().map(Vec::len), Some(2));
        assert_eq!(parsed["features"][0]["properties"]["heading_deg"], json!(270.0));
        let kml = kml(&[vehicle()]);
        assert!(kml.contains("-85.500000000,31.000000000,0") && kml.contains("ugv (a&lt;b) trail"));
        assert!(network_link("http://h/v.kml?a=1&b=2").contains("a=1&amp;b=2"));
    }
}
