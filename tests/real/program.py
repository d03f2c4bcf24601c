"""The program under test, and a figure that is held against a bar."""

import csv
import json
import subprocess
from dataclasses import dataclass


class Program:
    """The binary: its commands, and what they print."""

    def __init__(self, binary):
        self.binary = binary

    def run(self, *arguments):
        """Runs a command, gives what it wrote to its outputs; what it refuses is an error of the test."""
        done = subprocess.run([self.binary, *map(str, arguments)], capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"windhover {' '.join(map(str, arguments))} gave {done.returncode}: {done.stderr}")
        return done.stdout, done.stderr

    def json_lines(self, *arguments):
        """The objects that a command prints with --json, one a line."""
        return [json.loads(line) for line in self.run(*arguments, "--json")[0].splitlines()]


@dataclass
class Figure:
    """What was measured, and the bar: the least or the most that passes."""

    what: str
    value: float
    least: float | None = None
    most: float | None = None

    @property
    def holds(self):
        return (self.least is None or self.value >= self.least) and (self.most is None or self.value <= self.most)

    def __str__(self):
        bars = [f"at least {self.least}"] * (self.least is not None) + [f"at most {self.most}"] * (self.most is not None)
        return f"{self.what} {self.value:.4g} ({', '.join(bars)})"


def rows(path):
    """A table's rows by column name."""
    with open(path) as file:
        return list(csv.DictReader(file))
