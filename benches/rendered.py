"""What the whole pipeline makes of rendered flights, against their truth.

usage: rendered.py BINARY [--seconds S] [--seeds 1,2,3] [--folder DIR] [--set SECTION.KEY=VALUE]… [SCENARIO…]

Each scenario (default: all) is simulated for each seed (kept in the folder, default target/rendered, and made once),
replayed, and its estimates held against the truth from 6 s on: one row a vehicle and flight, and the mean over seeds
(root mean square of the errors). `--set` changes the flight's configuration for the replay, for example
`--set estimator.features=0`. Needs nothing beyond Python's library.
"""
import argparse
import collections
import csv
import math
import pathlib
import struct
import subprocess
import tempfile

BURN_S = 6.0
STATES = "nehvw"
COLUMNS = ("position m", "less mean m", "heading °", "speed m/s", "yaw rate rad/s", "NEES of these three",
           "heading", "speed", "yaw rate", "position NEES", "coverage")
ROOT_MEAN_SQUARES = 5
FORMATS = (".2f", ".2f", ".2f", ".3f", ".3f", ".1f", ".2f", ".2f", ".2f", ".1f", ".3f")


def run(*command):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stderr or done.stdout}")
    return done.stdout


def fitting(listed):
    """The scenarios of a list that their configuration fits: what is otherwise is said of the others."""
    lines = [line.split(maxsplit=1) for line in listed.splitlines()]
    return [name for name, about in lines if not about.startswith(("misfit: ", "absorbed: ", "condition: "))]


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def configuration(capture):
    """The text of the configuration attached to a capture."""
    with open(capture, "rb") as file:
        file.seek(8)
        while head := file.read(9):
            kind, length = head[0], struct.unpack("<Q", head[1:])[0]
            if kind != 9:
                file.seek(length, 1)
                continue
            body, at = file.read(length), 16
            for _ in ("name", "media type"):
                at += 4 + struct.unpack_from("<I", body, at)[0]
            size = struct.unpack_from("<Q", body, at)[0]
            return body[at + 8 : at + 8 + size].decode()
    raise SystemExit(f"{capture} has no configuration")


def changed(text, settings):
    """The configuration with `SECTION.KEY=VALUE` put in."""
    lines = text.splitlines()
    for setting in settings:
        place, value = setting.split("=", 1)
        section, key = place.rsplit(".", 1)
        if f"[{section}]" not in lines:
            lines += ["", f"[{section}]"]
        at = lines.index(f"[{section}]") + 1
        end = next((i for i in range(at, len(lines)) if lines[i].startswith("[")), len(lines))
        kept = [line for line in lines[at:end] if line.split("=")[0].strip() != key]
        lines[at:end] = [f"{key} = {value}", *kept]
    return "\n".join(lines) + "\n"


def solved(matrix, vector):
    """`vᵀ M⁻¹ v` by Cholesky's factors; not a number where M is no covariance."""
    n, total, factor, white = len(vector), 0.0, [], []
    for i in range(n):
        row = []
        for j in range(i + 1):
            rest = matrix[i][j] - sum(row[k] * (factor[j][k] if j < i else row[k]) for k in range(j))
            if i == j and not rest > 0:
                return math.nan
            row.append(math.sqrt(rest) if i == j else rest / factor[j][j])
        factor.append(row)
        white.append((vector[i] - sum(row[k] * white[k] for k in range(i))) / row[i])
        total += white[-1] ** 2
    return total


def metres_a_degree(lat_deg):
    """Along the meridian and along the parallel of WGS-84."""
    s, e2, a = math.sin(math.radians(lat_deg)), 0.00669437999014, 6378137.0
    w = 1.0 - e2 * s * s
    return math.radians(a * (1 - e2) / w**1.5), math.radians(a / math.sqrt(w) * math.cos(math.radians(lat_deg)))


def score(estimates, truth):
    """The figures of COLUMNS for one vehicle."""
    by_frame = {int(t["frame"]): t for t in truth}
    start = int(truth[0]["time_ns"]) + BURN_S * 1e9
    owed = sum(int(t["time_ns"]) >= start for t in truth)
    north_m, east_m = metres_a_degree(float(truth[0]["lat_deg"]))
    errors, normalised = [], collections.Counter()
    for e in estimates:
        t = by_frame.get(int(e["frame"]))
        if t is None or int(t["time_ns"]) < start or e["status"] not in ("tracking", "coasting") or not e["p_nn"]:
            continue
        apart = lambda key: float(e[key]) - float(t[key])
        error = [apart("lat_deg") * north_m, apart("lon_deg") * east_m, apart("heading_rad")]
        error[2] = math.remainder(error[2], math.tau)
        error += [apart("speed_mps"), apart("yaw_rate_radps")]
        p = [[float(e["p_" + "".join(sorted(a + b, key=STATES.index))]) for b in STATES] for a in STATES]
        part = lambda i, k: solved([r[i:k] for r in p[i:k]], error[i:k])
        errors.append(error)
        for name, i, k in (("all", 2, 5), ("h", 2, 3), ("v", 3, 4), ("w", 4, 5), ("place", 0, 2)):
            normalised[name] += part(i, k)
    n = len(errors)
    if n == 0:
        return [math.nan] * (len(COLUMNS) - 1) + [0.0]
    mean = lambda values: sum(values) / n
    middle = [mean(e[i] for e in errors) for i in range(2)]
    rms = lambda i: math.sqrt(mean(e[i] ** 2 for e in errors))
    figures = [math.hypot(rms(0), rms(1))]
    figures.append(math.sqrt(mean((e[0] - middle[0]) ** 2 + (e[1] - middle[1]) ** 2 for e in errors)))
    figures += [math.degrees(rms(2)), rms(3), rms(4)]
    return figures + [normalised[k] / n for k in ("all", "h", "v", "w", "place")] + [n / owed]


def fly(options, scenario, seed):
    """Simulates once, replays; the figures of each vehicle by its name."""
    capture = options.folder / f"{scenario}-{seed}-{options.seconds:g}.mcap"
    if not capture.exists():
        capture.parent.mkdir(parents=True, exist_ok=True)
        making = capture.with_name("making." + capture.name)
        run(options.binary, "simulate", making, "--scenario", scenario, "--seed", seed, "--duration", options.seconds)
        for made in sorted(capture.parent.glob(f"making.{capture.stem}*"), reverse=True):
            made.rename(made.with_name(made.name.removeprefix("making.")))
    with tempfile.TemporaryDirectory() as scratch:
        config, flight = pathlib.Path(scratch, "config.toml"), pathlib.Path(scratch, "flight.mcap")
        config.write_text(changed(configuration(capture), options.set))
        run(options.binary, "replay", capture, "--config", config, "--out", flight)
        run(options.binary, "export", flight, "--format", "csv", "--out", scratch)
        estimates = collections.defaultdict(list)
        for estimate in rows(pathlib.Path(scratch, "estimates.csv")):
            estimates[estimate["target"]].append(estimate)
    figures = {}
    for name, mine in estimates.items():
        others = capture.with_name(f"{capture.stem}.truth_{name}.csv")
        figures[name] = score(mine, rows(others if others.exists() else capture.with_name(f"{capture.stem}.truth.csv")))
    return figures


def main():
    parser = argparse.ArgumentParser(usage=__doc__.split("usage: ")[1].split("\n")[0])
    parser.add_argument("binary", type=pathlib.Path)
    parser.add_argument("scenarios", nargs="*")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seeds", type=lambda text: text.split(","), default=["1"])
    parser.add_argument("--folder", type=pathlib.Path, default=pathlib.Path("target/rendered"))
    parser.add_argument("--set", action="append", default=[])
    options = parser.parse_intermixed_args()
    listed = options.scenarios or fitting(run(options.binary, "simulate", "--list"))
    line = lambda name, figures: print(f"| {name} | " + " | ".join(map(format, figures, FORMATS)) + " |", flush=True)
    print("| flight | " + " | ".join(COLUMNS) + " |\n|" + "---|" * (len(COLUMNS) + 1))
    for scenario in listed:
        seen = collections.defaultdict(list)
        for seed in options.seeds:
            for name, figures in fly(options, scenario, seed).items():
                seen[name].append(figures)
                line(f"{scenario} {name}, seed {seed}", figures)
        for name, flights in seen.items():
            if len(flights) > 1:
                columns = list(zip(*flights))
                mean = lambda values: sum(values) / len(values)
                squares = [math.sqrt(mean([x * x for x in c])) for c in columns[:ROOT_MEAN_SQUARES]]
                line(f"**{scenario} {name}, mean**", squares + [mean(c) for c in columns[ROOT_MEAN_SQUARES:]])


if __name__ == "__main__":
    main()
