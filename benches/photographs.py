"""Whose corners explain a photograph: those listed beside it, AprilTag 3's with edges refined, or the project's.

usage: photographs.py BIN FOLDER     FOLDER holds NAME.jpg and NAME.txt, one line a tag of family 36h11:
                                     `id, (u v), (u v), (u v), (u v)`, pixel centres at one half (AprilTag's way)

The referee knows none of the detectors: the printed tag is drawn through the homography of four corners, blurred by
the best of five widths, its light fitted as black, white and a slope, and compared with the pixels inside it. What
remains, RMS in grey levels, is least for the right corners. Needs numpy and opencv-python-headless; pyapriltags is
left out where it is not installed.
"""
import json
import pathlib
import re
import subprocess
import sys

import cv2
import numpy as np

ORDERS = [[(i + k) % 4 for i in range(4)] for k in range(4)] + [[(k - i) % 4 for i in range(4)] for k in range(4)]
SAMPLES = 6
BLURS = (0.4, 0.6, 0.8, 1.0, 1.3)


def printed(number):
    """Reflectance of the 10×10 cells of a tag with its ring."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    cells = np.ones((10, 10))
    cells[1:9, 1:9] = cv2.aruco.generateImageMarker(family, number, 8, borderBits=1) > 128
    return cells


def unexplained(image, corners, cells):
    """Grey levels RMS that the tag drawn at these corners leaves, in the best of its eight orders."""
    margin = 2 + 0.08 * np.ptp(corners, axis=0)
    low = np.maximum(np.floor(corners.min(0) - margin).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(0) + margin).astype(int), [image.shape[1] - 1, image.shape[0] - 1])
    width, height = high - low + 1
    u = (np.arange(width * SAMPLES) + 0.5) / SAMPLES - 0.5 + low[0]
    v = (np.arange(height * SAMPLES) + 0.5) / SAMPLES - 0.5 + low[1]
    u, v = np.meshgrid(u, v)
    coarse = lambda fine: fine.reshape(height, SAMPLES, width, SAMPLES).mean((1, 3))
    pixels = image[low[1] : high[1] + 1, low[0] : high[0] + 1].astype(float)
    du, dv = np.meshgrid(np.arange(width) - width / 2, np.arange(height) - height / 2)
    best = np.inf
    for order in ORDERS:
        square = np.array([[1, 1], [9, 1], [9, 9], [1, 9]], np.float32)
        h = cv2.getPerspectiveTransform(corners[order].astype(np.float32), square)
        w = h[2, 0] * u + h[2, 1] * v + h[2, 2]
        x, y = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / w, (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / w
        drawn = cells[np.clip(y, 0, 9).astype(int), np.clip(x, 0, 9).astype(int)]
        inside = coarse(((x > 0.6) & (y > 0.6) & (x < 9.4) & (y < 9.4)).astype(float)) > 0.99
        for blur in BLURS:
            light = coarse(cv2.GaussianBlur(drawn, (0, 0), blur * SAMPLES))[inside]
            basis = np.c_[np.ones_like(light), light, light * du[inside], light * dv[inside]]
            seen = pixels[inside]
            rest = seen - basis @ np.linalg.lstsq(basis, seen, rcond=None)[0]
            best = min(best, float(np.sqrt(np.mean(rest**2))))
    return best


def nearest(found, corners):
    """The detection of the same tag, if there is one."""
    near = [c for c in found if np.linalg.norm(c.mean(0) - corners.mean(0)) < 4]
    return near[0] if near else None


def listed(path):
    """Number and corners, pixel centres at integers, of every line of a list."""
    for line in path.read_text().splitlines():
        numbers = [float(x) for x in re.findall(r"-?\d+\.\d+", line)]
        if len(numbers) == 8:
            yield int(line.split(",")[0]), np.array(numbers).reshape(4, 2) - 0.5


def main():
    """Prints what is found and what each leaves."""
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        from pyapriltags import Detector

        peer = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0, quad_sigma=0.0, refine_edges=1)
    except ImportError:
        peer = None
    total, rows, apart, peer_apart = 0, [], [], []
    distance = lambda a, b: min(np.linalg.norm(a[o] - b, axis=1).max() for o in ORDERS)
    for path in sorted(pathlib.Path(sys.argv[2]).glob("*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        command = [sys.argv[1], "detect", str(path), "--json", "--min-px", "12"]
        out = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        ours = [np.array(d["corners"]) for d in out["detections"]]
        theirs = [d.corners - 0.5 for d in peer.detect(image)] if peer else []
        for number, corners in listed(path.with_suffix(".txt")):
            total += 1
            own, refined = nearest(ours, corners), nearest(theirs, corners)
            if refined is not None:
                peer_apart.append(distance(refined, corners))
            if own is None:
                print(f"{path.name}: the tag at {corners.mean(0).round(1)} is missed")
                continue
            apart.append(distance(own, corners))
            cells = printed(number)
            left = [unexplained(image, c, cells) for c in (corners, own)]
            rows.append(left + [unexplained(image, refined, cells) if refined is not None else np.nan])
    rows, apart, peer_apart = np.array(rows), np.array(apart), np.array(peer_apart)
    print(f"{len(rows)} of {total} found; {np.sum(apart > 0.5)} more than 0.5 px from the list, {apart.max():.2f} at most")
    if len(peer_apart):
        print(f"AprilTag 3 with edges refined: {np.sum(peer_apart > 0.5)} of {len(peer_apart)}, {peer_apart.max():.2f} at most")
    for k, name in enumerate(("listed", "project", "AprilTag 3 refined")):
        print(f"{name}: {np.nanmedian(rows[:, k]):.2f} grey levels left (median), {np.nanmean(rows[:, k]):.2f} (mean)")
    far = apart > 0.5
    print(f"the project leaves less than the list in {np.sum(rows[:, 1] < rows[:, 0])} of {len(rows)} tags, in "
          f"{np.sum(rows[far, 1] < rows[far, 0])} of the {far.sum()} that differ by more than 0.5 px")


if __name__ == "__main__":
    main()
