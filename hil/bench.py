#!/usr/bin/env python3
"""Flies the virtual payload computer: boots it, feeds a simulated flight in real time, and asserts.

    hil/bench.py [--image target/hil] [--windhover target/release/windhover] [--tools target/release/examples]
                 [--long] [SCENARIO…]

The image and the flight are those that hil/image.sh made. Without scenarios the short set runs; scenarios that
are named share one boot. Results go to <image>/results.json, each machine's files beside it.
"""

import argparse
import json
import sys
import time
import traceback
from pathlib import Path

from flight import ERRORS, Flight
from scenarios import LANDED, LONG, SHORT


def fly_row(args, row, results):
    """Runs scenarios on one machine, on a new one after a failure."""
    flight = None
    for scenario in row:
        name, began = scenario.__name__, time.monotonic()
        result = {"ok": True}
        try:
            if flight is None:
                flight = Flight(args, name)
                flight.take_off()
            result |= scenario(flight)
        except ERRORS as error:
            result = {"ok": False, "error": str(error)}
            traceback.print_exc()
            flight = ended(flight, args)
        result["took_s"] = round(time.monotonic() - began)
        results[name] = result
        print(f"{'ok  ' if result['ok'] else 'FAIL'} {name}: {json.dumps(result)}", flush=True)
        (Path(args.image) / "results.json").write_text(json.dumps(results, indent=1))
    ended(flight, args)


def in_rows(scenarios):
    """Scenarios named by hand in rows: a machine that has landed flies no further."""
    rows = [[]]
    for scenario in scenarios:
        rows[-1].append(scenario)
        if scenario in LANDED:
            rows.append([])
    return [row for row in rows if row]


def ended(flight, args):
    if flight is not None:
        if args.stay:
            print(f"the machine stays: {flight.machine.work}; Enter ends it", flush=True)
            sys.stdin.readline()
        flight.end()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--image", default="target/hil")
    parser.add_argument("--windhover", default="target/release/windhover")
    parser.add_argument("--tools", default="target/release/examples", help="where what feeds the machine was built")
    parser.add_argument("--long", action="store_true", help="every scenario")
    parser.add_argument("--stay", action="store_true", help="after a failure and at the end, wait for Enter before the machine ends")
    parser.add_argument("scenario", nargs="*")
    args = parser.parse_args()
    args.capture, args.truth = (str(Path(args.image) / name) for name in ("flight.mcap", "flight.truth.csv"))
    for tool in ("feed", "frames", "stream"):
        setattr(args, tool, str(Path(args.tools) / f"hil_{tool}"))
    every = {scenario.__name__: scenario for rows in (SHORT, LONG) for row in rows for scenario in row}
    rows = in_rows([every[name] for name in args.scenario]) if args.scenario else LONG if args.long else SHORT
    results = {}
    for row in rows:
        fly_row(args, row, results)
    return 0 if all(result["ok"] for result in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
