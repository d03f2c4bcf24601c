"""Frames drawn by somebody else, with the true corners of every tag: recall, false tags, errors of the corners."""

import json
import math

from photographs import middle, near
from program import Figure

LEAST_PX = 16
# The bars of `figures` leave a tag, and a sixth of an error, to what was measured: 54 of 56, 0.078 and 0.138 px.
# A tag's corners may be listed from any of them on, in either direction.
ORDERS = [[(k + s * i) % 4 for i in range(4)] for k in range(4) for s in (1, -1)]


def figures(program, folder):
    truth = json.loads((folder / "truth.json").read_text())["frames"]
    paths = sorted(folder.glob("frame_*.png"))
    seen = program.json_lines("detect", *paths, "--family", "36h11", "--min-px", LEAST_PX)
    tags = hits = false = 0
    errors = {36: [], 60: []}
    for frame, drawn in zip(seen, truth, strict=True):
        owed = [tag for tag in drawn["tags"] if tag["side"] >= LEAST_PX]
        tags += len(owed)
        for found in frame["detections"]:
            # A tag smaller than asked for may be found: it is neither a hit nor false.
            same = [tag for tag in drawn["tags"] if is_of(found, tag)]
            false += not same
            for tag in (tag for tag in same if tag in owed):
                hits += 1
                size = 60 if tag["side"] >= 60 else 36
                if tag["side"] >= size:
                    errors[size] += corner_errors(found["corners"], tag["corners"])
    yield Figure(f"tags found of {tags} from {LEAST_PX} px on", hits, least=53)
    yield Figure("false tags", false, most=0)
    yield Figure("corners of tags from 60 px on, RMS px", rms(errors[60]), most=0.09)
    yield Figure("corners of tags from 36 to 60 px, RMS px", rms(errors[36]), most=0.16)


def is_of(found, tag):
    apart = max(4.0, 0.2 * tag["side"])
    return found["id"] == tag["id"] and near(middle(found["corners"]), middle(tag["corners"]), apart)


def corner_errors(found, true):
    """Distances of the four corners in the order that fits best."""
    return min(([math.dist(found[i], t) for i, t in zip(order, true)] for order in ORDERS), key=sum)


def rms(values):
    return math.sqrt(sum(v * v for v in values) / len(values))
