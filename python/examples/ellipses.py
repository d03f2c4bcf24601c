"""Where a vehicle was and how well that was known: a 95 % ellipse a second, as GeoJSON.

    python ellipses.py flight.mcap [target] > ellipses.geojson
"""

import json
import sys

import numpy as np

from windhover_flight import Flight

# A point of a plane normal distribution lies within 2.4477 sigma with 95 %: √(−2 ln 0.05).
WITHIN = np.sqrt(-2 * np.log(0.05))
METRES_A_DEGREE = 111_320.0


def ellipse(row, p):
    """Corners of the ellipse of (north, east) about a place, in degrees."""
    variances, axes = np.linalg.eigh(p)
    angle = np.linspace(0, 2 * np.pi, 37)
    north, east = axes @ (WITHIN * np.sqrt(variances)[:, None] * [np.cos(angle), np.sin(angle)])
    lat = row.lat_deg + north / METRES_A_DEGREE
    lon = row.lon_deg + east / (METRES_A_DEGREE * np.cos(np.radians(row.lat_deg)))
    return np.column_stack([lon, lat]).round(9).tolist()


def main(path, target=None):
    flight = Flight(path)
    target = target or flight.targets[0]
    states, covariance = flight.states(target), flight.covariance(target)[:, :2, :2]
    features, next_ns = [], 0
    for (time_ns, row), p in zip(states.iterrows(), covariance):
        if time_ns < next_ns or row.status != "tracking" or not np.isfinite(p).all():
            continue
        next_ns = time_ns + 10**9
        features.append({
            "type": "Feature",
            "properties": {"target": target, "utc": str(flight.utc(time_ns)), "sigma_m": float(np.sqrt(np.trace(p)))},
            "geometry": {"type": "Polygon", "coordinates": [ellipse(row, p)]},
        })
    return {"type": "FeatureCollection", "features": features}


if __name__ == "__main__":
    json.dump(main(*sys.argv[1:]), sys.stdout)
