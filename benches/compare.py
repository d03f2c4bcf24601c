"""Compares the benchmarks of this tree with those kept in benches/figures.csv: ratios only, for machines differ.

`make bench-compare` runs the crates' criterion benchmarks and prints, for each, its time relative to a reference
benchmark of the same run, and how that ratio moved against the last kept row. `--keep` appends the ratios as a new row
of the file, with date and commit.
"""

import argparse
import csv
import datetime
import json
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[1]
FIGURES = ROOT / "benches/figures.csv"
# A benchmark that computes and allocates nothing else: every other one is stated relative to it.
REFERENCE = "store/frame/jpeg"
# Ratios that moved by more than this are marked.
MOVED = 0.1


def medians(criterion):
    """Median of each benchmark of criterion's folder, nanoseconds, by name."""
    found = {}
    for path in sorted(criterion.rglob("new/estimates.json")):
        name = "/".join(path.relative_to(criterion).parts[:-2])
        found[name] = json.loads(path.read_text())["median"]["point_estimate"]
    return found


def kept():
    """Rows of the kept figures: date, commit, name, ratio; the last of each name counts."""
    if not FIGURES.exists():
        return {}
    with open(FIGURES, newline="", encoding="utf-8") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--keep", action="store_true", help="append the ratios to benches/figures.csv")
    arguments.add_argument("--criterion", type=pathlib.Path, default=ROOT / "target/criterion")
    arguments.add_argument("--reference", default=REFERENCE)
    arguments = arguments.parse_args()
    found = medians(arguments.criterion)
    if not found:
        sys.exit(f"there are no results in {arguments.criterion}: run `make bench` first")
    reference = found.get(arguments.reference) or found[min(found)]
    before = kept()
    print(f"{'benchmark':<44} {'ratio':>10} {'kept':>10}  change")
    for name, median in found.items():
        ratio, last = median / reference, before.get(name)
        change = ratio / float(last["ratio"]) - 1 if last else 0.0
        mark = "  <-" if abs(change) > MOVED else ""
        was = f"{float(last['ratio']):10.4g}" if last else f"{'–':>10}"
        print(f"{name:<44} {ratio:10.4g} {was}  {change:+6.1%}{mark}")
    if arguments.keep:
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT, check=True)
        today, is_new = datetime.date.today().isoformat(), not FIGURES.exists()
        with open(FIGURES, "a", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            if is_new:
                rows.writerow(["date", "commit", "name", "ratio"])
            rows.writerows([today, commit.stdout.strip(), name, f"{median / reference:.5g}"] for name, median in found.items())


if __name__ == "__main__":
    main()
