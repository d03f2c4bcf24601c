"""Real photographs: with tags that AprilTag 3 lists beside them, of one tag turned step by step, and without any; and a lens
calibrated from photographs of a chessboard."""

import math
import re

from program import Figure

SIZES = (8, 12, 16, 24)
# All but 16h5, whose few bits chance makes.
FAMILIES = "36h11,25h9,41h12,52h13,48h12,circle21h7,circle49h12,aruco_4x4_50,aruco_5x5_50,aruco_6x6_250,aruco_mip_36h12"


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
    lost = sum(larger_tags_lost(program, photograph) for photograph in sorted((folder / "apriltag").glob("*.jpg")))
    # One of 30 px is found at 16 px only.
    yield Figure("tags found from 12 or 16 px on, a tenth larger than asked for and not found from 16 or 24 px on", lost, most=1)
    turned = sorted((folder / "tilt_series").glob("*.png"))
    yield Figure(f"tags found in {len(turned)} pictures of a tilt series", found_in(program, turned), least=len(turned))
    boards = sorted((folder / "chessboard_left").glob("*.jpg"))
    lines = [line for px in SIZES for line in program.json_lines("detect", *boards, "--min-px", px, "--family", FAMILIES)]
    false = sum(len(line["detections"]) for line in lines)
    yield Figure(f"tags of any family in {len(boards)} photographs without, at four sizes", false, most=0)
    (lens,) = program.json_lines("calibrate", "intrinsics", *boards, "--board", "9x6", "--square-m", "0.025")
    yield Figure(f"photographs of a chessboard used, of {len(boards)}", lens["images_used"], least=len(boards))
    # OpenCV's fit of the same terms: 536.073, 536.016, 342.370, 235.537 px, 0.4087 px.
    for name, theirs in (("fx", 536.073), ("fy", 536.016), ("cx", 342.370), ("cy", 235.537)):
        yield Figure(f"{name} less OpenCV's, in its sigmas", abs(lens[name] - theirs) / lens["sigma"][name], most=2)
    yield Figure("residuals of that lens, RMS px", lens["rms_px"], most=0.41)


def detections(program, path, px=12):
    (line,) = program.json_lines("detect", path, "--min-px", px)
    return line["detections"]


def larger_tags_lost(program, path):
    """How many tags are found at some size and not from another on that is smaller than they are."""
    seen = {px: [(d["id"], middle(d["corners"]), edge(d["corners"])) for d in detections(program, path, px)] for px in (12, 16, 24)}
    is_in = lambda tag, tags: any(tag[0] == other[0] and near(tag[1], other[1], 0.3 * tag[2]) for other in tags)
    return sum(
        tag[2] > 1.1 * px and not is_in(tag, seen[px])
        for px in (16, 24)
        for other in (12, 16)
        if other < px
        for tag in seen[other]
        if other == 12 or not is_in(tag, seen[12])
    )


def edge(corners):
    """Mean length of the four sides."""
    return sum(math.dist(corners[k], corners[k - 1]) for k in range(4)) / 4


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
