"""Flights of an independent simulator, replayed from their bytes and frames, against their truth from 6 s on."""

import pathlib
import sys
import tempfile

from program import Figure, rows

sys.path.append(str(pathlib.Path(__file__).resolve().parents[2] / "benches"))
from rendered import COLUMNS, score  # noqa: E402

# The most that passes, by flight and table: position less its mean (m), heading (degrees), speed (m/s), yaw rate
# (rad/s), NEES of the last three where 3 is ideal. What was measured stands beside.
BARS = {
    "follow estimates": [0.24, 0.15, 0.014, 0.010, 3.0],  # 0.19, 0.143, 0.0118, 0.0074, 2.2
    "follow smoothed": [0.23, 0.15, 0.003, 0.002, 3.0],  # 0.182, 0.116, 0.0019, 0.0012, 0.49
    "hover10 estimates": [0.10, 0.55, 0.001, 0.0005, 3.0],  # 0.079, 0.410, 0.0003, 0.0001, 0.29
    "hover10 smoothed": [0.10, 0.55, 0.001, 0.0005, 3.0],  # 0.079, 0.390, 0.0002, 0.0001, 0.31
}
HELD = [COLUMNS.index(name) for name in ("less mean m", "heading °", "speed m/s", "yaw rate rad/s", "NEES of these three")]
COVERAGE = 0.99


def figures(program, folder):
    for flight in sorted(path.parent for path in folder.glob("*/capture.mcap")):
        with tempfile.TemporaryDirectory() as scratch:
            out = pathlib.Path(scratch)
            program.run("replay", flight / "capture.mcap", "--config", flight / "config.toml", "--out", out / "flight.mcap")
            program.run("export", out / "flight.mcap", "--format", "csv", "--out", out)
            truth = rows(flight / "truth.csv")
            for table in ("estimates", "smoothed"):
                yield from held(f"{flight.name} {table}", score(rows(out / f"{table}.csv"), truth))


def held(name, measured):
    """The figures that have a bar; a flight without bars must still be covered."""
    yield Figure(f"{name} coverage", measured[-1], least=COVERAGE)
    for column, most in zip(HELD, BARS.get(name, [])):
        yield Figure(f"{name} {COLUMNS[column]}", measured[column], most=most)
