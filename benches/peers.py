"""The detector and its peers from PyPI on one folder of frames, in one run; prints a Markdown table.

usage: peers.py BIN FOLDER        FOLDER holds pictures (PNG, JPEG) and truth.json (a list `frames` in order of the
                                  pictures' names, with the corners of every tag of 36h11, pixel centres at integers).
                                  Without truth.json only times and numbers of tags are given, and how many
                                  of them the project finds too

Needs numpy and opencv-python-headless; times pyapriltags and napa-vision where they are installed, and says
so where they are not. It installs nothing. The project is timed by its own `ms` (detection alone, image in
memory), the peers in process; each the best of three. One thread. Compare ratios: other load moves all.
"""
import json
import pathlib
import subprocess
import sys
import time

import cv2
import numpy as np

ORDERS = [[(i + k) % 4 for i in range(4)] for k in range(4)] + [[(k - i) % 4 for i in range(4)] for k in range(4)]
LEAST_PX = 16


def score(found, truth):
    """Hits, false ones, and corner errors by size class of one detector's detections."""
    hits, false, errors = 0, 0, {60: [], 36: []}
    for tags, frame in zip(found, truth):
        matched = set()
        for tag in (t for t in frame["tags"] if t["side"] >= LEAST_PX):
            corners = np.array(tag["corners"])
            for k, (number, seen) in enumerate(tags):
                near = np.linalg.norm(seen.mean(0) - corners.mean(0)) < max(4, 0.2 * tag["side"])
                if number == tag["id"] and near:
                    error = min((seen[o] - corners for o in ORDERS), key=lambda e: np.abs(e).sum())
                    size = 60 if tag["side"] >= 60 else 36 if tag["side"] >= 36 else None
                    if size:
                        errors[size].append(error)
                    hits += 1
                    matched.add(k)
                    break
        false += len(tags) - len(matched)
    rms = lambda e: float(np.sqrt(2 * np.mean(np.concatenate(e) ** 2))) if e else float("nan")
    return hits, false, rms(errors[60]), rms(errors[36])


def of_project(binary, paths, min_px):
    """Detections and milliseconds of the project's binary."""
    best, found = None, None
    for _ in range(3):
        command = [binary, "detect", *map(str, paths), "--json", "--min-px", str(min_px)]
        lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
        rows = [json.loads(line) for line in lines]
        ms = np.array([row["ms"] for row in rows])
        best = ms if best is None else np.minimum(best, ms)
        found = [[(d["id"], np.array(d["corners"])) for d in row["detections"]] for row in rows]
    return found, best


def of_peer(detect, frames):
    """Detections and milliseconds of a peer called in process."""
    detect(frames[0])
    found, times = [], []
    for frame in frames:
        best = float("inf")
        for _ in range(3):
            start = time.perf_counter()
            tags = detect(frame)
            best = min(best, time.perf_counter() - start)
        found.append(tags)
        times.append(best * 1e3)
    return found, np.array(times)


def peers():
    """Name and function of every peer that is installed."""
    try:
        import napa_vision

        for least in (24, 16):
            detector = napa_vision.NapaDetector(min_tag_px=least)
            yield f"napa-vision, min {least} px", lambda image, d=detector: [
                (int(t.tag_id), np.asarray(t.corners).reshape(4, 2)) for t in d.detect(image)
            ]
    except ImportError:
        print("napa-vision is not installed: left out", file=sys.stderr)
    try:
        from pyapriltags import Detector

        for decimate in (2.0, 1.0):
            detector = Detector(families="tag36h11", nthreads=1, quad_decimate=decimate, quad_sigma=0.0)
            # AprilTag puts pixel centres at one half.
            yield f"AprilTag 3, decimate {decimate:g}", lambda image, d=detector: [
                (t.tag_id, t.corners - 0.5) for t in d.detect(image)
            ]
    except ImportError:
        print("pyapriltags is not installed: left out", file=sys.stderr)


def main():
    """Times everything and prints the table."""
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    binary, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not paths:
        sys.exit(f"{folder}: no pictures")
    frames = [np.ascontiguousarray(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE)) for p in paths]
    listed = folder / "truth.json"
    if not listed.exists():
        return without_truth(binary, paths, frames)
    truth = json.loads(listed.read_text())["frames"]
    total = sum(t["side"] >= LEAST_PX for f in truth for t in f["tags"])
    print("| detector | median ms | p95 ms | found | false | RMS ≥60 px | RMS 36–60 px |")
    print("|---|---|---|---|---|---|---|")

    def row(name, found, ms):
        hits, false, large, middle = score(found, truth)
        print(
            f"| {name} | {np.median(ms):.2f} | {np.percentile(ms, 95):.2f} | {hits}/{total} | {false} "
            f"| {large:.3f} | {middle:.3f} |",
            flush=True,
        )

    for least in (24, 16):
        row(f"windhover, min {least} px", *of_project(binary, paths, least))
    for name, detect in peers():
        row(name, *of_peer(detect, frames))


def without_truth(binary, paths, frames):
    """Times of pictures of which nobody listed the tags, and what they have in common with the project's."""
    print("| detector | median ms | p95 ms | tags | of them found at min 12 px |")
    print("|---|---|---|---|---|")
    most, _ = of_project(binary, paths, 12)

    def row(name, found, ms):
        tags = sum(len(tags) for tags in found)
        both = sum(
            any(n == number and np.linalg.norm(seen.mean(0) - c.mean(0)) < 0.3 * np.linalg.norm(c[0] - c[1]) for n, c in ours)
            for tags, ours in zip(found, most)
            for number, seen in tags
        )
        print(f"| {name} | {np.median(ms):.2f} | {np.percentile(ms, 95):.2f} | {tags} | {both} |", flush=True)

    for least in (24, 16, 12):
        row(f"windhover, min {least} px", *of_project(binary, paths, least))
    for name, detect in peers():
        row(name, *of_peer(detect, frames))


if __name__ == "__main__":
    main()
