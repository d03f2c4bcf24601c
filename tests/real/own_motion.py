"""Real flights without a camera: the helicopter's own state against the flight's own log, from 10 s on.

A flight is a folder with `gps.log`, `compass.log`, `frames/`, `config.toml`, `truth.csv` (`time_s`, `lat_deg`, `lon_deg`, `alt_m`,
`vn`, `ve`, `vd` in m/s, `roll_deg`, `pitch_deg`, `heading_deg`). Each is flown as it is configured and with each kind of tilt sensor
named.
"""

import bisect
import math
import pathlib
import tempfile

from program import Figure, rows

KINDS = ["auto", "inertial"]
# Share of the true tilt that is shown, by third of the flight. What was measured is 0.99 to 1.01.
SLOPE = (0.95, 1.05)
# The most that passes, by flight: tilt error of both axes (degrees), horizontal velocity (m/s), position where the log is RTK (m).
BARS = {
    "dot1": (2.6, 0.25, 0.35),  # 1.79, 0.133, 0.211
    "quad123": (2.6, 0.25, None),  # 0.71, 0.209
    "quadOptFlowLogData": (2.6, 0.25, None),  # 0.78, 0.231
}
OTHERS = (3.5, 0.3, None)
BURN_S = 10.0
METRES_A_DEGREE = (110_900.0, 111_320.0)


def figures(program, folder):
    for flight in sorted(path.parent for path in folder.glob("*/gps.log")):
        for kind in KINDS:
            yield from held(f"{flight.name} {kind}", flown(program, flight, kind), BARS.get(flight.name, OTHERS))


def flown(program, flight, kind):
    """The helicopter's own state by the program: rows of time (s) and values."""
    with tempfile.TemporaryDirectory() as scratch:
        out = pathlib.Path(scratch)
        config = (flight / "config.toml").read_text().replace("[compass]\n", f'[compass]\ntilt = "{kind}"\n')
        (out / "config.toml").write_text(config)
        program.run("import", "--gps", flight / "gps.log", "--compass", flight / "compass.log", "--video", flight / "frames",
                    "--config", out / "config.toml", "--out", out / "capture.mcap")
        program.run("replay", out / "capture.mcap", "--out", out / "flight.mcap")
        program.run("export", out / "flight.mcap", "--format", "csv", "--out", out)
        return errors(rows(out / "ownship.csv"), rows(flight / "truth.csv"))


def errors(table, log):
    """What is compared at each row: true tilt, tilt (pitch and roll each, degrees), errors of velocity and position."""
    log = [{name: float(value) for name, value in row.items()} for row in log]
    times = [row["time_s"] for row in log]
    begin = max(times[0], float(table[0]["time_ns"]) * 1e-9) + BURN_S
    compared = []
    for row in table:
        t = float(row["time_ns"]) * 1e-9
        k = bisect.bisect(times, t)
        if t < begin or not 0 < k < len(times):
            continue
        share = (t - times[k - 1]) / (times[k] - times[k - 1])
        true = {name: log[k - 1][name] + share * (log[k][name] - log[k - 1][name]) for name in log[k] if name != "heading_deg"}
        w, x, y, z = (float(row[name]) for name in ("qw", "qx", "qy", "qz"))
        pitch = math.degrees(math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))))
        roll = math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
        north = (float(row["lat_deg"]) - true["lat_deg"]) * METRES_A_DEGREE[0]
        east = (float(row["lon_deg"]) - true["lon_deg"]) * METRES_A_DEGREE[1] * math.cos(math.radians(true["lat_deg"]))
        velocity = math.hypot(float(row["vn_mps"]) - true["vn"], float(row["ve_mps"]) - true["ve"])
        compared.append((true["pitch_deg"], true["roll_deg"], pitch, roll, velocity, math.hypot(north, east)))
    return compared


def held(name, compared, bars):
    third = len(compared) // 3
    for k in range(3):
        part = compared[k * third:(k + 1) * third]
        shown = sum(tp * p + tr * r for tp, tr, p, r, _, _ in part)
        slope = shown / sum(tp * tp + tr * tr for tp, tr, *_ in part)
        yield Figure(f"{name} share of the tilt, third {k + 1}", slope, least=SLOPE[0], most=SLOPE[1])
    rms = lambda squares: math.sqrt(sum(squares) / len(compared))  # noqa: E731
    tilt = rms((p - tp) ** 2 + (r - tr) ** 2 for tp, tr, p, r, _, _ in compared)
    measured = [tilt, rms(row[4] ** 2 for row in compared), rms(row[5] ** 2 for row in compared)]
    for what, value, most in zip(("tilt error °", "velocity m/s", "position m"), measured, bars):
        if most is not None:
            yield Figure(f"{name} {what}", value, most=most)
