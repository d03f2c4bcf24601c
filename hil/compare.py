"""What a flight off the card is held against: the simulated truth, its own replay, the ground station."""

import csv
import json
import math
import statistics
import subprocess
from itertools import zip_longest
from pathlib import Path

from machine import Failure


def demand(condition, words):
    """A scenario's assertion."""
    if not condition:
        raise Failure(words)


def rows(path):
    with open(path) as file:
        return list(csv.DictReader(file))


def middle(values):
    """The median of the magnitudes."""
    return statistics.median(map(abs, values)) if values else math.inf


def run(*command):
    """Runs a tool; its standard output."""
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode != 0:
        raise Failure(f"{' '.join(map(str, command))}: exit {done.returncode}: {done.stderr.strip()[-400:]}",
                      done.stdout.splitlines())
    return done.stdout


def exported(args, flight, work):
    """The flight's tables as CSV; their folder."""
    out = Path(work) / f"export-{Path(flight).stem}"
    run(args.windhover, "export", flight, "--format", "csv", "--out", out)
    return out


def frames_shown(args, flight):
    """Frames of a flight by their number: which frame of the feed each shows, empty where none."""
    seen = csv.DictReader(run(args.frames, flight).splitlines())
    return {int(row["frame"]): row["number"] for row in seen}


def metres(row, true):
    """How far north and east a row's place is of the vehicle's true one."""
    north = (float(row["lat_deg"]) - float(true["lat_deg"])) * 111_132.0
    east = (float(row["lon_deg"]) - float(true["lon_deg"])) * 111_320.0
    return north, east * math.cos(math.radians(float(true["lat_deg"])))


def against_truth(args, flight, work):
    """Figures of a flight: frames, estimates, median errors against the truth of the picture each frame shows.

    The bench's clocks are not one: pictures, receiver and compass run through an emulator, tenths of a second
    apart, more on a busy machine, where the filter then takes a frame for an outlier now and again. So this
    proves function and not accuracy. `position_m` is of the vehicle as seen from
    the helicopter, whose own error (the receiver's slow one, metres, and how late the emulator gave its
    sentences) is in `absolute_m` alone.
    """
    shown = frames_shown(args, flight)
    truth = {int(r["frame"]): r for r in rows(args.truth)}
    true_own = {int(r["frame"]): r for r in rows(args.truth.replace(".csv", "_ownship.csv"))}
    tables = exported(args, flight, work)
    own = {int(r["frame"]): r for r in rows(tables / "ownship.csv") if r["frame"]}
    estimates = [r for r in rows(tables / "estimates.csv") if r["status"] == "tracking" and r["lat_deg"]]
    distance, absolute, heading = [], [], []
    for row in estimates:
        number = shown.get(int(row["frame"]))
        true = truth.get(int(number)) if number else None
        if true is None:
            continue
        north, east = metres(row, true)
        absolute.append(math.hypot(north, east))
        helicopter, there = metres(own[int(row["frame"])], true), true_own[int(number)]
        north -= helicopter[0] - (float(there["n"]) - float(true["north_m"]))
        east -= helicopter[1] - (float(there["e"]) - float(true["east_m"]))
        distance.append(math.hypot(north, east))
        turn = float(row["heading_rad"]) - float(true["heading_rad"])
        heading.append(math.degrees(math.atan2(math.sin(turn), math.cos(turn))))
    return {
        "frames": len(shown),
        "estimates": len(estimates),
        "compared": len(distance),
        "position_m": round(middle(distance), 2),
        "absolute_m": round(middle(absolute), 2),
        "heading_deg": round(middle(heading), 2),
    }


def against_replay(args, flight, work):
    """What flew is what replays: how many rows of estimates are the same, and the first that is not.

    A frame the card had no time for is a gap in the frames' numbers: up to the first gap the rows must be
    the same.
    """
    kept = sorted(frames_shown(args, flight))
    whole = next((n for n, frame in enumerate(kept) if n != frame), len(kept))
    again = Path(work) / f"again-{flight.name}.mcap"
    again.unlink(missing_ok=True)
    run(args.windhover, "replay", flight, "--out", again)
    flown, replayed = (
        (exported(args, file, work) / "estimates.csv").read_text().splitlines()[1:] for file in (flight, again))
    same = 0
    for old, new in zip_longest(flown, replayed):
        if old is None or int(old.split(",")[1]) >= whole:
            break
        demand(old == new, f"estimates differ in the replay:\nflown    {old}\nreplayed {new}")
        same += 1
    return {"frames_kept": len(kept), "frames_before_a_gap": whole, "rows_equal": same}


def against_stream(args, flight, station):
    """What the ground has of a flight beside what the card has."""
    return json.loads(run(args.stream, flight, station))


def listed(args, store):
    """Flights of a store by session, as `windhover store list` tells them."""
    text = run(args.windhover, "store", "--path", store, "list", "--json")
    return {row["session"]: row for row in map(json.loads, text.splitlines())}
