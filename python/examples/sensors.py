"""What the sensors did: rates, the longest silence, and what became of their measurements in the filter.

    python sensors.py flight.mcap
"""

import sys

import numpy as np
import pandas as pd

from windhover_flight import Flight


def main(path):
    flight = Flight(path)
    rows = {}
    frames = np.array([frame.time_ns for frame in flight.frames()])
    for name, times in {"gps": flight.gps.index, "compass": flight.compass.index, "imu": flight.imu.index, "camera": frames}.items():
        if len(times) > 1:
            gaps = np.diff(np.sort(times)) / 1e9
            rows[name] = {"rate_hz": 1 / np.median(gaps), "longest_gap_s": gaps.max(), "messages": len(times)}
    fusion = flight.fusion
    became = fusion.groupby(["source", "disposition"]).size().unstack(fill_value=0)
    return pd.DataFrame(rows).T, became


if __name__ == "__main__":
    for part in main(sys.argv[1]):
        print(part.to_string(), "\n")
