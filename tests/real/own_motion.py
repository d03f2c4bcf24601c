"""Real flights without a camera: the helicopter's own state against the flight's own log, from 10 s on.

A flight is a folder with `gps.log`, `compass.log`, `frames/`, `config.toml`, `truth.csv` (`time_s`, `lat_deg`, `lon_deg`, `alt_m`,
`vn`, `ve`, `vd` in m/s, `roll_deg`, `pitch_deg`, `heading_deg`) and perhaps `imu.csv`. Each is flown as it is configured and with each
kind of tilt sensor named, with its IMU where it has one, and refined afterwards.
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
# The same of the refined flight. A line of the recording counts as complete at its time, so its fixes are taken 19 ms (74 bytes) before the
# time that they name: 0.107 m at this flight's speeds.
REFINED = {"dot1": (2.0, 0.12, 0.15)}  # 1.75, 0.062, 0.122
# An IMU whose axes point forward, left and up.
IMU = "\n[imu]\nroll_deg = 180.0\n"
BURN_S = 10.0
METRES_A_DEGREE = (110_900.0, 111_320.0)


def figures(program, folder):
    for flight in sorted(path.parent for path in folder.glob("*/gps.log")):
        for kind in KINDS:
            yield from held(f"{flight.name} {kind}", flown(program, flight, kind), BARS.get(flight.name, OTHERS))
        for with_imu in (False, True) if flight.name in REFINED else ():
            compared = flown(program, flight, KINDS[0], refined=True, with_imu=with_imu and (flight / "imu.csv").exists())
            name = f"{flight.name} refined" + (", IMU" if with_imu else "")
            yield from held(name, compared, REFINED[flight.name])


def rms(errors):
    """Root mean square."""
    return math.sqrt(sum(error * error for error in errors) / len(errors))


def flown(program, flight, kind, refined=False, with_imu=False):
    """The helicopter's own state by the program, in flight or refined afterwards: what is compared at each row."""
    with tempfile.TemporaryDirectory() as scratch:
        out = pathlib.Path(scratch)
        config = (flight / "config.toml").read_text().replace("[compass]\n", f'[compass]\ntilt = "{kind}"\n')
        (out / "config.toml").write_text(config + (IMU if with_imu else ""))
        imu = ["--imu", flight / "imu.csv"] if with_imu else []
        program.run("import", "--gps", flight / "gps.log", "--compass", flight / "compass.log", "--video", flight / "frames",
                    *imu, "--config", out / "config.toml", "--out", out / "capture.mcap")
        program.run("replay", out / "capture.mcap", "--out", out / "flight.mcap")
        if refined:
            program.run("refine", out / "flight.mcap")
        program.run("export", out / "flight.mcap", "--format", "csv", "--out", out)
        table = "ownship_refined.csv" if refined else "ownship.csv"
        return errors(rows(out / table), rows(flight / "truth.csv"))


def between(log, times, k, t):
    """The log at a time behind its row k − 1."""
    share = (t - times[k - 1]) / (times[k] - times[k - 1])
    return {name: log[k - 1][name] + share * (log[k][name] - log[k - 1][name]) for name in log[k] if name != "heading_deg"}


def apart(lat, lon, true):
    """North and east of a place from the log's, m."""
    north = (lat - true["lat_deg"]) * METRES_A_DEGREE[0]
    return north, (lon - true["lon_deg"]) * METRES_A_DEGREE[1] * math.cos(math.radians(true["lat_deg"]))


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
        true = between(log, times, k, t)
        w, x, y, z = (float(row[name]) for name in ("qw", "qx", "qy", "qz"))
        pitch = math.degrees(math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))))
        roll = math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
        north, east = apart(float(row["lat_deg"]), float(row["lon_deg"]), true)
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
    tilt = rms([math.hypot(p - tp, r - tr) for tp, tr, p, r, _, _ in compared])
    measured = [tilt, rms([row[4] for row in compared]), rms([row[5] for row in compared])]
    for what, value, most in zip(("tilt error °", "velocity m/s", "position m"), measured, bars):
        if most is not None:
            yield Figure(f"{name} {what}", value, most=most)
