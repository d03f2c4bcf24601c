"""How far off a flight was, and how honest: errors against the truth, and the normalised error squared (NEES), which averages
the number of figures where covariances are what they say. Places are compared on the Earth: flight and truth need not have the
same datum.

    python accuracy.py flight.mcap capture.truth.csv [target]
"""

import sys

import numpy as np
import pandas as pd

from windhover_flight import Flight

FIGURES = ["north_m", "east_m", "heading_rad", "speed_mps", "yaw_rate_radps"]


def metres(lat_deg, lat_error_deg, lon_error_deg):
    """Steps north and east of small steps of latitude and longitude, on WGS-84 at height zero."""
    a, e2, s = 6378137.0, 6.69437999014e-3, np.sin(np.radians(lat_deg))
    across = a / np.sqrt(1 - e2 * s**2)
    along = across * (1 - e2) / (1 - e2 * s**2)
    return along * np.radians(lat_error_deg), across * np.cos(np.radians(lat_deg)) * np.radians(lon_error_deg)


def accuracy(flight, truth, target, kind="filtered"):
    """Root mean square of each figure's error, and the mean NEES, over the frames in which it was tracked."""
    states, covariance = flight.states(target, kind), flight.covariance(target, kind)
    tracked = ((states.status == "tracking") & np.isfinite(covariance[:, 0, 0])).to_numpy()
    states, covariance = states[tracked], covariance[tracked]
    true = truth.loc[states.frame]
    error = states[FIGURES].to_numpy() - true[FIGURES].to_numpy()
    apart = (states[name].to_numpy() - true[name].to_numpy() for name in ("lat_deg", "lon_deg"))
    error[:, 0], error[:, 1] = metres(true.lat_deg.to_numpy(), *apart)
    error[:, 2] = np.arctan2(np.sin(error[:, 2]), np.cos(error[:, 2]))
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return pd.Series(np.sqrt((error**2).mean(axis=0)), FIGURES), float(nees.mean())


def main(path, truth_path, target=None):
    flight, truth = Flight(path), pd.read_csv(truth_path, index_col="frame")
    results = {}
    for kind in ("filtered", "smoothed", "refined"):
        if len(flight.states(target or flight.targets[0], kind)):
            results[kind] = accuracy(flight, truth, target or flight.targets[0], kind)
    return results


if __name__ == "__main__":
    for kind, (rms, nees) in main(*sys.argv[1:]).items():
        print(f"{kind}: NEES {nees:.2f}\n{rms.to_string()}\n")
