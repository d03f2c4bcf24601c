#!/usr/bin/env python3
"""Compare `windhover decode` with what gpsd makes of the same serial logs, field by field.

usage: tests/decode_vs_gpsd.py BINARY FOLDER

FOLDER holds gpsd's NAME.log and NAME.log.chk. For every epoch with a UTC the last report of gpsd
with that time is compared, and every attitude report of gpsd in its order. Each difference is
printed; docs/decode-vs-gpsd.md gives the reason of each. gpsd's eph and epv are rescaled, so they
are left out. Without arguments the comparison is skipped, and says so.
"""
import json
import pathlib
import subprocess
import sys
from collections import Counter
from datetime import datetime, timedelta

MODES = {0: "none", 1: "none", 2: "2d", 3: "3d"}
# gpsd's name, ours, and half a unit of the last digit gpsd prints
FIELDS = [
    ("lat", "lat_deg", 1e-9),
    ("lon", "lon_deg", 1e-9),
    ("altMSL", "alt_msl_m", 1e-4),
    ("geoidSep", "geoid_m", 1e-3),
    ("speed", "speed_mps", 1e-3),
    ("track", "course_deg", 1e-3),
]


def run(binary, *arguments):
    done = subprocess.run([binary, "decode", *arguments, "--json"], capture_output=True, text=True, check=True)
    return [json.loads(line) for line in done.stdout.splitlines()], done.stderr.strip()


def gpsd_reports(path):
    """TPV by time, fields of the last that has them, and ATT in order."""
    fixes, attitudes = {}, []
    for line in path.read_text(errors="replace").splitlines():
        if not line.startswith('{"class"'):
            continue
        report = json.loads(line)
        if report["class"] == "TPV" and "time" in report:
            # Reports of one time are of one sentence each; mode 0 is of one that tells no fix.
            known = fixes.get(report["time"], {"mode": 0})
            mode = report["mode"] or known["mode"]
            fixes[report["time"]] = {**known, **report, "mode": mode}
        elif report["class"] == "ATT":
            attitudes.append(report)
    return fixes, attitudes


def an_era_later(utc):
    """The same time after 1024 weeks, into which gpsd moves dates it takes for rolled over."""
    later = datetime.fromisoformat(utc.replace("Z", "+00:00")) + timedelta(weeks=1024)
    return later.strftime("%Y-%m-%dT%H:%M:%S.") + f"{later.microsecond // 1000:03}Z"


def compare_fix(ours, theirs, differ):
    if ours["fix"] != MODES[theirs["mode"]]:
        differ("fix", ours["fix"], MODES[theirs["mode"]])
    for their_name, name, tolerance in FIELDS:
        a, b = ours[name], theirs.get(their_name)
        if a is None and b is None:
            continue
        if a is None or b is None or abs(a - b) > tolerance:
            differ(name, a, b)


def main():
    if len(sys.argv) != 3:
        print("SKIPPED: give the binary and the folder of gpsd's logs")
        return 0
    binary, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    for log in sorted(folder.glob("*.log")):
        fixes, attitudes = gpsd_reports(log.with_suffix(".log.chk"))
        epochs, counts = run(binary, "gps", str(log))
        timed = [epoch for epoch in epochs if epoch["utc"]]
        differences, compared, missing = Counter(), 0, 0
        examples = {}
        for epoch in timed:
            theirs = fixes.get(epoch["utc"]) or fixes.get(an_era_later(epoch["utc"]))
            if theirs is None:
                missing += 1
                examples.setdefault("missing", epoch["utc"])
                continue
            compared += 1

            def differ(name, a, b, utc=epoch["utc"]):
                key = name + (": we leave it out" if a is None else ": gpsd leaves it out" if b is None else "")
                differences[key] += 1
                examples.setdefault(key, f"{utc} ours {a} gpsd {b}")

            compare_fix(epoch, theirs, differ)
        ours = {epoch["utc"] for epoch in timed} | {an_era_later(epoch["utc"]) for epoch in timed}
        only = [time for time in fixes if time not in ours]
        print(f"{log.name}: {len(epochs)} epochs, {len(timed)} dated, {compared} compared, "
              f"{missing} not in gpsd's {examples.get('missing', '')}, {len(only)} only in gpsd's {only[:2]}")
        for key, count in sorted(differences.items()):
            print(f"    {count:4} {key}  e.g. {examples[key]}")
        print(f"    {counts}")
        if attitudes:
            compare_attitudes(binary, log, attitudes)
    return 0


def compare_attitudes(binary, log, attitudes):
    readings, counts = run(binary, "compass", str(log))
    for name in ("heading", "pitch", "roll"):
        ours = [r[name + "_deg"] for r in readings if r[name + "_deg"] is not None]
        theirs = [a[name] for a in attitudes if name in a]
        pairs = list(zip(ours, theirs))
        ratios = [b / a for a, b in pairs if abs(a) > 0.05]
        same = sum(abs(a - b) < 1e-3 for a, b in pairs)
        print(f"    compass {name}: {len(ours)} ours, {len(theirs)} gpsd, {same} the same"
              + (f", gpsd/ours {min(ratios):.3f} to {max(ratios):.3f}" if ratios else ""))
    print(f"    compass: {counts}")


if __name__ == "__main__":
    sys.exit(main())
