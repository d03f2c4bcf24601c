"""The machine in flight: booted, fed, received by a ground station, its daemon ready."""

import json
import re
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

from compare import demand, listed, run
from machine import Failure, Feed, Machine, Station

# Emulation is some ten times slower than the host, and slower where the host is busy: limits are for
# function, not speed.
READY_S = 600
ESTIMATE_S = 300
EVENT_S = 180
CONFIG = "/etc/windhover/windhover.toml"


class Flight:
    """One machine with one card, through as many boots as a scenario needs."""

    def __init__(self, args, name, **options):
        self.args = args
        image = Path(args.image)
        self.machine = Machine(image, image / name, **options)
        self.station = Station(self.machine, args.windhover)
        self.feed, self.pixel_format = None, "GREY"
        # Names of flights by what they are kept for.
        self.kept = {}

    def take_off(self):
        """Power on; returns when the daemon is ready."""
        self.machine.boot()
        self.machine.wait_for_control()
        self.keep_feeding()
        self.wait_ready()

    def keep_feeding(self):
        """Feeds the machine, again where a boot ended the last feed."""
        if self.feed is None or not self.feed.running():
            self.stop_feeding()
            self.feed = Feed(self.machine, self.args.feed, self.args.capture, self.pixel_format)

    def stop_feeding(self):
        if self.feed is not None:
            self.feed.stop()
            self.feed = None

    def wait_ready(self):
        machine, limit = self.machine, time.monotonic() + READY_S
        while machine.service("ActiveState") != "active":
            self.keep_feeding()
            if time.monotonic() > limit:
                raise Failure(f"not ready after {READY_S} s:\n" + machine.run("systemctl status windhover; true")
                              + "\n" + "\n".join(machine.journal()[-15:]))
            time.sleep(2)

    def line(self, words, after=0, seconds=EVENT_S):
        """The first line of the daemon's log with all these words, and the number of the next one."""
        limit = time.monotonic() + seconds
        while True:
            self.keep_feeding()
            try:
                return self.machine.wait_journal(words, 10, after)
            except Failure:
                if time.monotonic() > limit:
                    raise

    def lines(self):
        """How many lines the daemon's log has."""
        return len(self.machine.journal())

    def healthy_camera(self, what):
        """Frames come and the daemon says so, from now on."""
        limit = time.monotonic() + EVENT_S
        after, line = self.lines(), ""
        while time.monotonic() < limit:
            line, after = self.line(["health ", "camera_hz="], after)
            rate = float(re.search(r"camera_hz=([0-9.]+)", line).group(1))
            if rate > 0:
                return rate
        raise Failure(f"no frames {what}: {line}")

    def tracking(self, after=None, seconds=ESTIMATE_S):
        """The vehicle is tracked, from now on."""
        return self.line(["health ", "ugv=tracking"], self.lines() if after is None else after, seconds)

    def stop_daemon(self):
        """Stops the daemon; how long that took by the machine's own clock, seconds, and what it ended with."""
        return self._stop("windhover"), self.machine.service("Result")

    def stop_nothing(self):
        """How long the same takes of a service that ends at once: systemd, its bus and the emulation."""
        self.machine.run("systemd-run --quiet --unit=bench-nothing sleep 3600", 60)
        return self._stop("bench-nothing")

    def _stop(self, unit):
        script = f"a=$(date +%s%N); systemctl stop {unit}; b=$(date +%s%N); echo $(((b-a)/1000000))"
        return int(self.machine.run(script, 60).split()[-1]) / 1000

    def start_daemon(self):
        """Starts it; the number of the first line it says."""
        after = self.lines()
        self.machine.run("systemctl start --no-block windhover", 60)
        return after

    def configure(self, change):
        """Puts a changed configuration (a sed script) over the one of the read-only root."""
        machine = self.machine
        machine.run(f"umount {CONFIG}; sed -e '{change}' {CONFIG} >/run/bench-config && mount --bind /run/bench-config {CONFIG}")

    def configure_back(self):
        self.machine.run(f"umount {CONFIG}")

    def newest_flight(self):
        """The flight in the air, or the last one, as `store list` tells it in the machine."""
        rows = self.machine.run("windhover store list --json", 120)
        return sorted(sessions(rows).items())[-1]

    def cut_power(self):
        self.machine.power_cut()
        self.stop_feeding()

    def land(self):
        """The daemon stopped, the machine shut down; a copy of the card's files."""
        self.stop_daemon()
        self.stop_feeding()
        self.machine.shut_down()
        self.station.stop()
        store = self.machine.card_files()
        try:
            run(self.args.windhover, "store", "--path", store, "verify")
        except Failure as failure:
            # The emulated card may be too slow at the end for the index, which is made again of the segments;
            # they must be whole.
            faults = [line for line in failure.output if ": " in line and not line.startswith("index: ")]
            demand(not faults, f"{failure}: {faults}")
            run(self.args.windhover, "store", "--path", store, "rebuild")
            run(self.args.windhover, "store", "--path", store, "verify")
        return store

    def flights(self, store):
        """Directories of the flights in a copy of the card, by session."""
        return {session: store / "FLIGHTS" / row["flight"] for session, row in listed(self.args, store).items()}

    def end(self):
        self.stop_feeding()
        self.station.stop()
        self.machine.stop()


def sessions(text):
    """Rows of `windhover store list --json` by session."""
    rows = [json.loads(row) for row in text.splitlines() if row.startswith("{")]
    return {row["session"]: row for row in rows}


@contextmanager
def same_daemon(machine):
    """What happens inside does not end the daemon."""
    pid = machine.service("MainPID")
    yield pid
    demand(machine.service("MainPID") == pid, "the daemon was started again")


ERRORS = (Failure, OSError, subprocess.SubprocessError, ValueError, KeyError)
