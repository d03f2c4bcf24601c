"""Real photographs: with tags that AprilTag 3 lists beside them, of one tag turned step by step, and without any."""

import math
import re

from program import Figure


def figures(program, folder):
    listed = found = false = 0
    for photograph in sorted((folder / "apriltag").glob("*.jpg")):
        seen, tags = detections(program, photograph), list(in_list(photograph.with_suffix(".txt")))
        listed += len(tags)
        found += sum(any(d["id"] == number and near(middle(d["corners"]), at) for d in seen) for number, at in tags)
        # These photographs show no other number than those of their list.
        false += sum(d["id"] not in {number for number, _ in tags} for d in seen)
    yield Figure(f"tags found of the {listed} that AprilTag 3 lists", found, least=listed)
    yield Figure("tags of a number that the photographs do not show", false, most=0)
    turned = sorted((folder / "tilt_series").glob("*.png"))
    yield Figure(f"tags found in {len(turned)} pictures of a tilt series", found_in(program, turned), least=len(turned))
    boards = sorted((folder / "chessboard_left").glob("*.jpg"))
    yield Figure(f"of {len(boards)} photographs without tags, those with one", found_in(program, boards), most=0)


def detections(program, path):
    (line,) = program.json_lines("detect", path, "--min-px", "12")
    return line["detections"]


def found_in(program, paths):
    """In how many pictures a tag is found."""
    return sum(bool(detections(program, path)) for path in paths)


def in_list(path):
    """Number and middle of each tag of a list, pixel centres moved from one half to integers."""
    for line in path.read_text().splitlines():
        numbers = [float(x) - 0.5 for x in re.findall(r"-?\d+\.\d+", line)]
        if len(numbers) == 8:
            yield int(line.split(",")[0]), middle(list(zip(numbers[::2], numbers[1::2])))


def middle(corners):
    return [sum(axis) / len(corners) for axis in zip(*corners)]


def near(a, b, px=4.0):
    return math.dist(a, b) < px
