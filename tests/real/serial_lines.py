"""Captures of GPS receivers and compasses against what gpsd makes of them."""

import gpsd
from program import Figure

# Differences whose reasons docs/decode-vs-gpsd.md gives, by capture and kind; every other one fails.
KNOWN = {}


def figures(program, folder):
    for log in sorted(folder.glob("*.log")):
        found = gpsd.compare(program, log)
        print(f"     {log.name}: {found.compared} epochs and {found.angles} angles compared")
        known = KNOWN.get(log.stem, {})
        unknown = {kind: found.differences[kind] for kind in found.differences if kind not in known}
        yield Figure(f"{log.stem}: differences from gpsd of no known reason {found.examples(unknown)}", len(unknown), most=0)
        for kind, most in known.items():
            yield Figure(f"{log.stem}: {kind}", found.differences[kind], most=most)
