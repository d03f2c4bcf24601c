"""Captures of GPS receivers and compasses against what gpsd makes of them."""

import gpsd
from program import Figure

# The most of each kind of difference, by capture; docs/decode-vs-gpsd.md gives the reasons. What is not here fails.
KNOWN = {
    "foretrex-201": {"fix 2d here, 3d there": 6, "epoch only here": 1},
    "garmin-10x": {"fix 2d here, 3d there": 2, "epoch only here": 1},
    "garmin25lp": {"fix 2d here, 3d there": 9, "epoch only here": 10, "geoid_m only here": 1},
    "garmin38": {"alt_msl_m": 5},
    "hemi": {"epoch only in gpsd's": 113},
    "isync": {"epoch only here": 1},
    "quectel-l76k-nmea": {"epoch only here": 1},
    "rst39": {
        "epoch only here": 1,
        "geoid_m only in gpsd's": 39,
        "speed_mps only in gpsd's": 36,
        "heading: 100 here, 4 there": 1,
        "heading": 4,
        "pitch: 100 here, 0 there": 1,
        "roll: 100 here, 0 there": 1,
    },
    "tnt-revolution": {f"{angle} in counts there": 50 for angle in gpsd.ANGLES},
}


def figures(program, folder):
    for log in sorted(folder.glob("*.log")):
        found = gpsd.compare(program, log)
        known = KNOWN.get(log.stem, {})
        beyond = {kind: found.examples[kind] for kind, n in found.differences.items() if n > known.get(kind, 0)}
        what = f"{log.stem}, {found.compared} epochs, {found.angles} angles: differences from gpsd of no known reason"
        yield Figure(what + (f" {beyond}" if beyond else ""), len(beyond), most=0)
