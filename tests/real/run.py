#!/usr/bin/env python3
"""Runs the program over real recordings and frames, and holds its figures against bars.

usage: tests/real/run.py BINARY FOLDER [PART…]

Needs Python's own library only. A part is a file here with `figures(run, folder)`, which gives a `Figure` for each
thing that is held, and a row in PARTS: the folder below FOLDER that it reads. A folder that is not there is said and left out.
"""
import pathlib
import subprocess
import sys

import flights
import frames
import own_motion
import photographs
import pictures
import serial_lines
from program import Program

LEAVE_OUT = pathlib.Path(__file__).resolve().parents[2] / ".ci/skip"
PARTS = {
    "serial": (serial_lines, "serial"),
    "photographs": (photographs, "images"),
    "pictures": (pictures, "reports/images"),
    "frames": (frames, "detector"),
    "flights": (flights, "flights"),
    "own motion": (own_motion, "real"),
}


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    program, data, wanted = Program(sys.argv[1]), pathlib.Path(sys.argv[2]), sys.argv[3:] or PARTS
    passed = failed = 0
    for name in wanted:
        module, folder = PARTS[name]
        if not (data / folder).is_dir():
            subprocess.run(["sh", LEAVE_OUT, f"real data, {name}", f"no folder {data / folder}"], check=True)
            continue
        for figure in module.figures(program, data / folder):
            print(f"{'ok  ' if figure.holds else 'FAIL'} {name}: {figure}", flush=True)
            passed, failed = passed + figure.holds, failed + (not figure.holds)
    print(f"{passed} passed, {failed} failed")
    return 1 if failed or not passed else 0


if __name__ == "__main__":
    sys.exit(main())
