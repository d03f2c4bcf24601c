"""Compares a flight off the card with the simulated truth."""

import csv
import math
import subprocess
from pathlib import Path

from machine import Failure


def rows(path):
    with open(path) as file:
        return list(csv.DictReader(file))


def rms(values):
    return math.sqrt(sum(v * v for v in values) / len(values)) if values else math.inf


def compare(windhover, frames_tool, flight, truth_path, work):
    """Figures of a flight: frames, estimates, errors against the truth of the picture each frame shows.

    The bench's clocks are not one: pictures, receiver and compass run through an emulator, tens of
    milliseconds apart, so this proves function and not accuracy.
    """
    out = Path(work) / f"export-{flight.name}"
    subprocess.run([windhover, "export", str(flight), "--format", "csv", "--out", str(out)], check=True,
                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    seen = subprocess.run([frames_tool, str(flight)], check=True, capture_output=True, text=True).stdout
    shown = {r["frame"]: int(r["number"]) for r in csv.DictReader(seen.splitlines()) if r["number"]}
    truth = {int(r["frame"]): r for r in rows(truth_path)}
    estimates = [r for r in rows(out / "estimates.csv") if r["status"] == "tracking" and r["lat_deg"]]
    north, east, heading = [], [], []
    for row in estimates:
        true = truth.get(shown.get(row["frame"], -1))
        if true is None:
            continue
        lat = math.radians(float(true["lat_deg"]))
        north.append((float(row["lat_deg"]) - float(true["lat_deg"])) * 111_132.0)
        east.append((float(row["lon_deg"]) - float(true["lon_deg"])) * 111_320.0 * math.cos(lat))
        turn = float(row["heading_rad"]) - float(true["heading_rad"])
        heading.append(math.degrees(math.atan2(math.sin(turn), math.cos(turn))))
    return {
        "frames": len(seen.splitlines()) - 1,
        "numbered": len(shown),
        "estimates": len(estimates),
        "compared": len(north),
        "position_m": rms([math.hypot(n, e) for n, e in zip(north, east)]),
        "heading_deg": rms(heading),
    }


def demand(condition, words):
    """A scenario's assertion."""
    if not condition:
        raise Failure(words)
