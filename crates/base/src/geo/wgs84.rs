//! The WGS-84 ellipsoid and the local tangent frame at a datum.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

/// Semi-major axis, metres (WGS-84).
const A_M: f64 = 6_378_137.0;
/// Flattening (WGS-84).
const F: f64 = 1.0 / 298.257_223_563;
/// First eccentricity squared.
const E2: f64 = F * (2.0 - F);

/// A position by latitude, longitude (degrees, as in files) and height above the ellipsoid (metres).
///
/// ```
/// use windhover_base::geo::Geodetic;
///
/// let place = Geodetic { lat_deg: 47.0, lon_deg: 8.0, height_m: 400.0 };
/// let back = Geodetic::from_ecef(&place.to_ecef());
/// assert!((back.lat_deg - 47.0).abs() < 1e-12 && (back.height_m - 400.0).abs() < 1e-6);
/// ```
#[derive(Clone, Copy, PartialEq, Debug, Default, Serialize, Deserialize)]
pub struct Geodetic {
    /// Latitude, degrees, north positive.
    pub lat_deg: f64,
    /// Longitude, degrees, east positive.
    pub lon_deg: f64,
    /// Height above the ellipsoid, metres.
    pub height_m: f64,
}

impl Geodetic {
    /// Earth-centred Earth-fixed coordinates, metres.
    pub fn to_ecef(self) -> Vector3<f64> {
        let (slat, clat) = self.lat_deg.to_radians().sin_cos();
        let (slon, clon) = self.lon_deg.to_radians().sin_cos();
        let n = A_M / (1.0 - E2 * slat * slat).sqrt();
        Vector3::new(
            (n + self.height_m) * clat * clon,
            (n + self.height_m) * clat * slon,
            (n * (1.0 - E2) + self.height_m) * slat,
        )
    }

    /// From Earth-centred coordinates: Bowring's latitude, then three fixed-point steps, with an error below a
    /// nanometre near the surface.
    pub fn from_ecef(ecef: &Vector3<f64>) -> Self {
        let p = ecef.x.hypot(ecef.y);
        let lon = ecef.y.atan2(ecef.x);
        let b = A_M * (1.0 - F);
        let beta = (ecef.z * A_M).atan2(p * b);
        let ep2 = E2 / (1.0 - E2);
        let mut lat = (ecef.z + ep2 * b * beta.sin().powi(3)).atan2(p - E2 * A_M * beta.cos().powi(3));
        for _ in 0..3 {
            let beta = ((1.0 - F) * lat.sin()).atan2(lat.cos());
            lat = (ecef.z + ep2 * b * beta.sin().powi(3)).atan2(p - E2 * A_M * beta.cos().powi(3));
        }
        let (slat, clat) = lat.sin_cos();
        let n = A_M / (1.0 - E2 * slat * slat).sqrt();
        let height_m = p * clat + ecef.z * slat - A_M * A_M / n;
        Self { lat_deg: lat.to_degrees(), lon_deg: lon.to_degrees(), height_m }
    }
}

/// The NED tangent frame at a datum.
///
/// ```
/// use windhover_base::geo::{Geodetic, LocalFrame};
/// use nalgebra::Vector3;
///
/// let frame = LocalFrame::new(Geodetic { lat_deg: 47.0, lon_deg: 8.0, height_m: 400.0 });
/// let point = Vector3::new(120.0, -35.0, -10.0);
/// assert!((frame.ned(frame.geodetic(&point)) - point).norm() < 1e-6);
/// ```
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct LocalFrame {
    datum: Geodetic,
    origin_ecef: Vector3<f64>,
    ned_from_ecef: Matrix3<f64>,
}

impl LocalFrame {
    /// The frame whose origin is `datum`.
    pub fn new(datum: Geodetic) -> Self {
        let (slat, clat) = datum.lat_deg.to_radians().sin_cos();
        let (slon, clon) = datum.lon_deg.to_radians().sin_cos();
        let ned_from_ecef = Matrix3::new(
            -slat * clon,
            -slat * slon,
            clat,
            -slon,
            clon,
            0.0,
            -clat * clon,
            -clat * slon,
            -slat,
        );
        Self { datum, origin_ecef: datum.to_ecef(), ned_from_ecef }
    }

    /// The frame's origin.
    pub fn datum(&self) -> Geodetic {
        self.datum
    }

    /// North, east, down (metres) of a position.
    pub fn ned(&self, position: Geodetic) -> Vector3<f64> {
        self.ned_from_ecef * (position.to_ecef() - self.origin_ecef)
    }

    /// The position of a point given as north, east, down (metres).
    pub fn geodetic(&self, ned: &Vector3<f64>) -> Geodetic {
        Geodetic::from_ecef(&(self.origin_ecef + self.ned_from_ecef.transpose() * ned))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_point_in_ecef() {
        // The north pole and the equator are exact by definition of the ellipsoid.
        let pole = Geodetic { lat_deg: 90.0, lon_deg: 0.0, height_m: 0.0 }.to_ecef();
        assert!((pole.z - 6_356_752.314_245).abs() < 1e-5 && pole.x.abs() < 1e-6);
        let equator = Geodetic { lat_deg: 0.0, lon_deg: 90.0, height_m: 10.0 }.to_ecef();
        assert!((equator.y - 6_378_147.0).abs() < 1e-8);
    }

    #[test]
    fn local_frame_goes_there_and_back() {
        for (lat_deg, lon_deg) in [(30.07, -85.58), (-45.0, 170.0), (0.0, 0.0), (89.9, 12.0)] {
            let frame = LocalFrame::new(Geodetic { lat_deg, lon_deg, height_m: 33.0 });
            for ned in [Vector3::new(0.0, 0.0, 0.0), Vector3::new(120.0, -340.0, -60.0)] {
                let back = frame.ned(frame.geodetic(&ned));
                assert!((back - ned).norm() < 1e-7, "{lat_deg} {lon_deg}: {back}");
            }
        }
    }

    #[test]
    fn north_is_north() {
        let datum = Geodetic { lat_deg: 30.0, lon_deg: -85.0, height_m: 0.0 };
        let frame = LocalFrame::new(datum);
        let north = frame.ned(Geodetic { lat_deg: 30.001, ..datum });
        assert!(north.x > 110.0 && north.y.abs() < 1e-6);
        let east = frame.ned(Geodetic { lon_deg: -84.999, ..datum });
        assert!(east.y > 95.0 && east.x.abs() < 1e-2);
    }
}
