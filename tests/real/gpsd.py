"""One serial capture: what `windhover decode` makes of it against gpsd's reports (NAME.log.chk), field by field.

For every epoch with a UTC gpsd's reports of that time are compared, and every attitude report of gpsd in its order.
gpsd's eph and epv are rescaled, so they are left out.
"""

import json
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
ANGLES = ("heading", "pitch", "roll")
ANGLE_DEG = 1e-3
# gpsd keeps what some compasses send as it is.
COUNTS_A_TURN = 65536


class Comparison:
    """How much was compared, and the differences: how many of each kind, with one example."""

    def __init__(self):
        self.compared = self.angles = 0
        self.differences, self.examples = Counter(), {}

    def differ(self, kind, example):
        self.differences[kind] += 1
        self.examples.setdefault(kind, example)


def compare(program, log):
    """What differs between the program's and gpsd's reading of a capture."""
    found = Comparison()
    fixes, attitudes = reports(log.with_name(log.name + ".chk"))
    epochs = [epoch for epoch in program.json_lines("decode", "gps", log) if epoch["utc"]]
    for epoch in epochs:
        theirs = fixes.get(epoch["utc"]) or fixes.get(an_era_later(epoch["utc"]))
        if theirs is None:
            found.differ("epoch only here", epoch["utc"])
            continue
        found.compared += 1
        compare_fix(found, epoch, theirs)
    ours = {epoch["utc"] for epoch in epochs} | {an_era_later(epoch["utc"]) for epoch in epochs}
    for time in fixes.keys() - ours:
        found.differ("epoch only in gpsd's", time)
    if attitudes:
        compare_attitudes(found, program.json_lines("decode", "compass", log), attitudes)
    return found


def reports(path):
    """TPV by time, fields of the last that has them, and ATT in order."""
    fixes, attitudes, sentence = {}, [], ""
    for line in path.read_text(errors="replace").splitlines():
        if not line.startswith('{"class"'):
            sentence = line
            continue
        report = json.loads(line)
        if report["class"] == "TPV" and "time" in report:
            # Reports of one time are of one sentence each; mode 0 is of one without a word on the fix.
            known = fixes.get(report["time"], {"mode": 0})
            mode = report["mode"] or known["mode"]
            fixes[report["time"]] = {**known, **report, "mode": mode}
        elif report["class"] == "ATT" and "XDR" not in sentence:
            # An XDR says the same angles again.
            attitudes.append(report)
    return fixes, attitudes


def an_era_later(utc):
    """The same time after 1024 weeks, into which gpsd moves dates it takes for rolled over."""
    later = datetime.fromisoformat(utc.replace("Z", "+00:00")) + timedelta(weeks=1024)
    return later.strftime("%Y-%m-%dT%H:%M:%S.") + f"{later.microsecond // 1000:03}Z"


def compare_fix(found, ours, theirs):
    mode = MODES[theirs["mode"]]
    if ours["fix"] != mode:
        found.differ(f"fix {ours['fix']} here, {mode} there", ours["utc"])
    for their_name, name, tolerance in FIELDS:
        a, b = ours[name], theirs.get(their_name)
        if a is None and b is None:
            continue
        if a is None or b is None or abs(a - b) > tolerance:
            kind = " only in gpsd's" if a is None else " only here" if b is None else ""
            found.differ(name + kind, f"{ours['utc']} ours {a} gpsd {b}")


def compare_attitudes(found, readings, attitudes):
    for name in ANGLES:
        ours = [r[name + "_deg"] for r in readings if r[name + "_deg"] is not None]
        theirs = [a[name] for a in attitudes if name in a]
        if len(ours) != len(theirs):
            found.differ(f"{name}: {len(ours)} here, {len(theirs)} there", f"first {ours[:1]} and {theirs[:1]}")
        for a, b in zip(ours, theirs):
            found.angles += 1
            if abs(a - b) > ANGLE_DEG:
                counts = abs(a * COUNTS_A_TURN / 360 - b) < 0.01
                found.differ(name + (" in counts there" if counts else ""), f"ours {a} gpsd {b}")
