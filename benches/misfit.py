"""What the whole pipeline makes of flights that their configuration does not fit, against nominal twins.

usage: misfit.py BINARY [--seconds S] [--seeds 1,2,3,4] [--folder DIR] [--set SECTION.KEY=VALUE]… [ROW…]

Each row (default: all of ROWS) is simulated for each seed beside a twin of the same seed that fits (kept in the folder,
default target/misfit, and made once), both are replayed and held against the truth from 6 s on. A line a row, over its
seeds: root mean squares of heading, speed and yaw rate over the twins', and of heading over that of the paper's estimator
in the same flights; NEES of the three together (3 is right) and each; NEES of position (2 is right); share of frames with
an estimate; what misfits were reported, and how many of the flights reported it. `--with NAME=FIGURE` as a ROW flies that
deviation. Needs nothing beyond Python's library.
"""
import argparse
import collections
import math
import pathlib
import re
import subprocess
import tempfile

import rendered

UNICYCLE = ('model = "ackermann"', 'model = "unicycle"')
# What is flown, and its twin: arguments of `windhover simulate`; then what is changed in the twin's configuration.
ROWS = {
    "tags 2 % larger": ("tag-size=2", "", None),
    "tags 5 % larger": ("tag-size=5", "", None),
    "one tag 5 % larger": ("one-tag-size=5", "", None),
    "one tag 5 cm off": ("one-tag-ahead=5", "", None),
    "one tag turned 5°": ("one-tag-turn=5", "", None),
    "both tags turned 5°": ("tag-turn=5", "", None),
    "ground 10 m lower": ("ground-lower=10", "", None),
    "take-off elevation, started in the air": ("takeoff-in-air", "", None),
    "ground 4 m lower, at 5 m": ("ground-lower=4 height=5", "height=5", None),
    "two people": ("people=2", "", None),
    "six people": ("people=6", "", None),
    "another vehicle": ("convoy=1", "", None),
    "the same ids twice": ("same-ids=1", "", None),
    "stamps jitter by 1 ms": ("stamp-jitter=1", "", None),
    "stamps jitter by 3 ms": ("stamp-jitter=3", "", None),
    "stamps jitter by 10 ms": ("stamp-jitter=10", "", None),
    "camera 40 ms late": ("camera-late=40", "", None),
    "rolling shutter 25 ms": ("readout=25", "", None),
    "rolling shutter 25 ms, configured": ("told-readout=25", "", None),
    "rolling shutter 25 ms, vibration": ("readout=25 vibration=0.1", "vibration=0.1", None),
    "rolling shutter 15 ms, 12 m/s": ("readout=15 speed=12", "speed=12", None),
    "pitches, rolls and bounces": ("sway=3 bounce=5", "", None),
    "turns on the spot as ackermann": ("spin=0.8", "spin=0.8", UNICYCLE),
    "slides sideways": ("slip=10", "", None),
    "3 m/s²": ("hurry=3", "", None),
    "starts from rest, still helicopter": (
        "from-rest=10 hover=15 wind=0.3 gusts=0.05 restless=0.02", "hover=15 wind=0.3 gusts=0.05 restless=0.02 speed=0.8", None),
    "out of view and back, 5 frames/s": ("gone=1.5 fps=5", "fps=5", None),
    "antenna 30 cm off": ("antenna=30", "", None),
    "antenna 1 m off": ("antenna=100", "", None),
    "velocity filtered, 0.3 s": ("velocity-filter=0.3", "", None),
    "receiver wanders 3 times as far": ("gps-wander=3", "", None),
    "distortion left out": ("no-distortion", "", None),
    "image_top wrong": ("image-top=1", "", None),
    "all of it a little": ("all-a-little", "", None),
    "absorbed: declination 3°": ("declination=3", "", None),
    "absorbed: mount 2°": ("mount=2", "", None),
    "absorbed: focal length 1 %": ("focal=1", "", None),
    "absorbed: GPS 150 ms late": ("gps-late=150", "", None),
    "absorbed: compass 60 ms late": ("compass-late=60", "", None),
    "absorbed: 15 % of the tilt": ("tilt-share=15", "", None),
    "absorbed: vibration 0.1°": ("vibration=0.1", "", None),
    "absorbed: mud on a tag": ("mud=30", "", None),
}


def flight(options, what, seed):
    """The capture of `follow` with these deviations (or of a scenario of one word without a figure), made once."""
    words = what.split()
    scenario = words.pop(0) if words and words[0] in options.scenarios else "follow"
    name = re.sub(r"[^a-z0-9.]+", "-", what) or "nominal"
    capture = options.folder / f"{name}-{seed}-{options.seconds:g}.mcap"
    if not capture.exists():
        capture.parent.mkdir(parents=True, exist_ok=True)
        making = capture.with_name("making." + capture.name)
        extra = [part for word in words for part in ("--with", word)]
        rendered.run(options.binary, "simulate", making, "--scenario", scenario, "--seed", seed, "--duration",
                     options.seconds, *extra)
        for made in sorted(capture.parent.glob(f"making.{capture.stem}*"), reverse=True):
            made.rename(made.with_name(made.name.removeprefix("making.")))
    return capture


def figures(options, capture, change):
    """Figures of the filter, the paper's heading error, and the misfits reported."""
    truth = rendered.rows(capture.with_name(f"{capture.stem}.truth.csv"))
    with tempfile.TemporaryDirectory() as scratch:
        config, out = pathlib.Path(scratch, "config.toml"), pathlib.Path(scratch, "flight.mcap")
        text = rendered.changed(rendered.configuration(capture), options.set)
        config.write_text(text.replace(*change) if change else text)
        command = [options.binary, "replay", capture, "--config", config, "--out", out, "--log"]
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{command}\n{done.stderr}")
        rendered.run(options.binary, "export", out, "--format", "csv", "--out", scratch)
        estimates = [e for e in rendered.rows(pathlib.Path(scratch, "estimates.csv")) if e["target"] == "ugv"]
        paper = rendered.rows(pathlib.Path(scratch, "paper.csv"))
    reported = re.findall(r"event=model_misfit.*?source=(\S+)", done.stderr + done.stdout)
    return rendered.score(estimates, truth), paper_heading_deg(paper, truth), sorted(set(reported))


def paper_heading_deg(paper, truth):
    true = {int(t["frame"]): t for t in truth}
    start = int(truth[0]["time_ns"]) + rendered.BURN_S * 1e9
    errors = [
        math.remainder(float(p["heading_rad"]) - float(true[int(p["frame"])]["heading_rad"]), math.tau)
        for p in paper
        if p["heading_rad"] and int(p["frame"]) in true and int(p["time_ns"]) >= start
    ]
    return math.degrees(math.sqrt(sum(e * e for e in errors) / len(errors))) if errors else math.nan


def squares(values):
    return math.sqrt(sum(v * v for v in values) / len(values))


def row(options, name, what, twin, change):
    flown, twins, paper, reported = [], [], [], collections.Counter()
    for seed in options.seeds:
        mine, theirs, misfits = figures(options, flight(options, what, seed), None)
        flown.append(mine)
        paper.append(theirs)
        reported.update(misfits)
        key = (twin, seed, change)
        if key not in options.twins:
            options.twins[key] = figures(options, flight(options, twin, seed), change)[0]
        twins.append(options.twins[key])
    mine, theirs = list(zip(*flown)), list(zip(*twins))
    ratios = [squares(mine[i]) / squares(theirs[i]) for i in (2, 3, 4)]
    mean = lambda i: sum(mine[i]) / len(mine[i])
    cells = [f"{r:.2g}" if r < 10 else f"{r:.0f}" for r in ratios + [squares(mine[2]) / squares(paper)]]
    cells += [f"{mean(i):.1f}" for i in (5, 6, 7, 8, 9)] + [f"{mean(10):.3f}"]
    cells.append(", ".join(f"{source} {count}" for source, count in sorted(reported.items())) or "–")
    print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(usage=__doc__.split("usage: ")[1].split("\n")[0])
    parser.add_argument("binary", type=pathlib.Path)
    parser.add_argument("rows", nargs="*", help="; ".join(ROWS))
    parser.add_argument("--seconds", type=float, default=24.0)
    parser.add_argument("--seeds", type=lambda text: text.split(","), default=["1", "2", "3", "4"])
    parser.add_argument("--folder", type=pathlib.Path, default=pathlib.Path("target/misfit"))
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--with", action="append", default=[], dest="others")
    options = parser.parse_intermixed_args()
    options.twins = {}
    listed = rendered.run(options.binary, "simulate", "--list").splitlines()
    options.scenarios = [line.split()[0] for line in listed]
    chosen = {name: ROWS[name] for name in options.rows or ([] if options.others else ROWS)}
    chosen |= {what: (what, "", None) for what in options.others}
    print(f"| what is not as configured | heading × | speed × | yaw rate × | heading, of the paper's | NEES of the three "
          "| heading | speed | yaw rate | position NEES | coverage | misfits reported |\n|" + "---|" * 12)
    for name, (what, twin, change) in chosen.items():
        row(options, name, what, twin, change)


if __name__ == "__main__":
    main()
