#!/usr/bin/env python3
"""Flies the virtual payload computer: boots it, feeds a simulated flight in real time, and asserts.

    hil/bench.py --image target/hil --windhover target/release/windhover \\
                 --feed target/release/examples/hil_feed --frames target/release/examples/hil_frames \\
                 [--capture CAPTURE.mcap --truth TRUTH.csv] [--long] [SCENARIO…]

Without scenarios the short set runs. Results go to <image>/results.json, each machine's files beside it.
"""

import argparse
import json
import random
import re
import subprocess
import sys
import time
import traceback
from contextlib import contextmanager
from pathlib import Path

from compare import compare, demand
from machine import Failure, Feed, Machine

# Emulation is some ten times slower than the host: limits are for function, not speed.
READY_S = 600
ESTIMATE_S = 300
EVENT_S = 180
POSITION_M = 4.0
HEADING_DEG = 12.0


class Flight:
    """The machine in flight: booted, fed, its daemon ready."""

    def __init__(self, args, name, **options):
        self.args = args
        image = Path(args.image)
        self.machine = Machine(image, image / name, **options)
        self.feed = None

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
            self.feed = Feed(self.machine, self.args.feed, self.args.capture)

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
                              + "\n" + "\n".join(machine.journal().splitlines()[-15:]))
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
        return len(self.machine.journal().splitlines())

    def healthy_camera(self, what):
        """Frames come and the daemon says so, from now on."""
        line, _ = self.line(["health ", "camera_hz="], self.lines())
        rate = float(re.search(r"camera_hz=([0-9.]+)", line).group(1))
        demand(rate > 0, f"no frames {what}: {line}")
        return rate

    def cut_power(self):
        self.machine.power_cut()
        self.stop_feeding()

    def land(self):
        """The daemon stopped, the machine shut down; the flights on the card."""
        self.machine.run("systemctl stop windhover", 60)
        self.stop_feeding()
        self.machine.shut_down()
        return self.machine.flights()

    def end(self):
        self.stop_feeding()
        self.machine.stop()


@contextmanager
def same_daemon(machine):
    """What happens inside does not end the daemon."""
    pid = machine.service("MainPID")
    yield pid
    demand(machine.service("MainPID") == pid, "the daemon was started again")


def cold_boot(flight):
    """From power on to ready, to an estimate, to a flight on the card that agrees with the truth."""
    machine, args = flight.machine, flight.args
    ready = machine.since_boot()
    flight.line(["health ", "ugv=tracking"], seconds=ESTIMATE_S)
    estimate = machine.since_boot()
    # The sandbox holds on a real boot: no root, nothing writable but the card, devices open.
    demand(machine.run("ps -o user= -C windhover").split() == ["windhover"], "the daemon runs as root")
    demand(machine.run("findmnt -no OPTIONS / | tr , '\\n' | grep -x ro") == "ro", "the root is writable")
    ports = machine.run("ss -Hlnutp | grep -c windhover; true")
    demand(ports == "0", f"{ports} open ports that nobody configured")
    time.sleep(40)
    memory = machine.service("MemoryCurrent")
    began = time.monotonic()
    machine.run("systemctl stop windhover", 60)
    stopped = time.monotonic() - began
    result = machine.service("Result")
    demand(result == "success", f"stopping ended with {result}")
    flights = flight.land()
    demand(flights, "no flight on the card")
    figures = compare(args.windhover, args.frames, flights[-1], args.truth, machine.work)
    figures |= {"ready_s": round(ready, 1), "first_estimate_s": round(estimate, 1),
                "stop_s": round(stopped, 2), "memory_mb": round(int(memory) / 1e6, 1)}
    demand(figures["compared"] >= 20, f"too few estimates to compare: {figures}")
    demand(figures["position_m"] < POSITION_M, f"position is off: {figures}")
    demand(figures["heading_deg"] < HEADING_DEG, f"heading is off: {figures}")
    return figures


def unplug(flight):
    """Each device goes away and comes back; each is told, none ends the daemon."""
    machine = flight.machine
    with same_daemon(machine) as pid:
        for part in ("gps", "compass"):
            after = flight.lines()
            slot = machine.unplug_serial(part)
            flight.line(["device_down", f"about={part}"], after)
            time.sleep(3)
            machine.plug_serial(slot)
            flight.line(["device_up", f"about={part}"], after)
        # The camera: vivid's own control makes it vanish for a while.
        after = flight.lines()
        machine.run("v4l2-ctl -d /dev/video0 -c disconnect=1", check=False)
        flight.line(["device_down", "about=camera"], after)
        flight.line(["device_up", "about=camera"], after)
    return {"pid": int(pid)}


def camera_faults(flight):
    """Errors, lost and wrongly stamped buffers by the driver's own fault injection."""
    machine, seen = flight.machine, {}
    with same_daemon(machine):
        for control, words in (("percentage_of_dropped_buffers=60", "camera_frames_missed"),
                               ("inject_dqbuf_error=1", None), ("inject_buf_queue_error=1", None)):
            after = flight.lines()
            machine.run(f"v4l2-ctl -d /dev/video0 -c {control}")
            if words:
                flight.line([words], after)
            time.sleep(6)
            machine.run("v4l2-ctl -d /dev/video0 -c percentage_of_dropped_buffers=0", check=False)
            time.sleep(10)
            seen[control.split("=")[0]] = flight.healthy_camera(f"after {control}")
    return seen


def hang(flight):
    """A daemon that hangs: the watchdog has the daemon started again, and it is ready again."""
    machine = flight.machine
    pid = machine.service("MainPID")
    # SIGSTOP stops every thread of the process, not one task alone: the watchdog is no longer stroked.
    machine.run(f"kill -STOP {pid}")
    began = time.monotonic()
    while machine.service("MainPID") in (pid, "0"):
        demand(time.monotonic() - began < EVENT_S, "the watchdog did not end the hung daemon")
        time.sleep(1)
    took = time.monotonic() - began
    flight.wait_ready()
    return {"restarted_after_s": round(took, 1)}


def sessions(text):
    """Estimates and bytes by session of `windhover store list --json`."""
    flights = [json.loads(row) for row in text.splitlines() if row.startswith("{")]
    return {flight["session"]: (flight["estimates"], flight["bytes"]) for flight in flights}


def acknowledged(flight):
    """Estimates by session that are durable by now: the flight has been written to and synced since they
    were seen. One thread writes, syncs, and only then writes again."""
    listed = lambda: sessions(flight.machine.run("windhover store --path /var/lib/windhover list --json", 120))
    seen = listed()
    newest, limit, grown, last = max(seen), time.monotonic() + EVENT_S, 0, None
    while grown < 2:
        size = listed().get(newest, (0, 0))[1]
        grown += last is not None and size > last
        last = size
        demand(time.monotonic() < limit, "the flight does not grow")
        time.sleep(0.5)
    return {session: estimates for session, (estimates, _) in seen.items()}


def power_cut(flight, cuts=2):
    """Power goes at random moments; every boot afterwards seals what was cut and flies again. What the
    daemon had said is on the card is still there."""
    durable = {}
    for cut in range(cuts):
        if cut:
            flight.take_off()
        flight.line(["health ", "ugv=tracking"], seconds=ESTIMATE_S)
        durable |= acknowledged(flight)
        time.sleep(random.uniform(0, 3))
        flight.cut_power()
    flight.take_off()
    flights = flight.land()
    listing = subprocess.run([flight.args.windhover, "store", "--path", str(flights[0].parent.parent), "list", "--json"],
                             check=True, capture_output=True, text=True)
    found = {session: estimates for session, (estimates, _) in sessions(listing.stdout).items()}
    demand(len(flights) > cuts, f"{len(flights)} flights after {cuts} cuts")
    lost = {session: (count, found.get(session)) for session, count in durable.items() if found.get(session, 0) < count}
    demand(not lost, f"estimates that were on the card (asked, found): {lost}")
    return {"durable": durable, "found": found}


def power_cut_long(flight):
    """The same ten times."""
    return power_cut(flight, 10)


def card_full(flight):
    """A card too small for the flight: that is told, estimates go on, and the daemon lives."""
    with same_daemon(flight.machine):
        flight.line(["recording_stopped"], seconds=600)
        return {"camera_hz": flight.healthy_camera("with a full card")}


def card_errors(flight):
    """The card answers with I/O errors (dm-flakey's module, its error target) and the daemon flies on."""
    machine = flight.machine
    machine.run("systemctl stop windhover && umount /var/lib/windhover && modprobe dm-flakey", 120)
    sectors = machine.run("blockdev --getsz /dev/sda")
    machine.run(f"echo 0 {sectors} linear /dev/sda 0 | dmsetup create card")
    machine.run("mount /dev/mapper/card /var/lib/windhover && systemctl start --no-block windhover", 120)
    flight.wait_ready()
    with same_daemon(machine):
        after = flight.lines()
        # Up for no second, down for thirty, again and again: every request fails.
        machine.run(f"echo 0 {sectors} flakey /dev/sda 0 0 30 | dmsetup reload card "
                    "&& dmsetup suspend --nolockfs --noflush card && dmsetup resume card")
        flight.line(["recording_stopped"], after)
        return {"camera_hz": flight.healthy_camera("with a failing card")}


# What a scenario needs of its machine, where it is not the usual one.
OPTIONS = {"card_full": {"card_mb": 48}}
# Those that leave the machine flying: one boot serves several in a row.
STAY_UP = [unplug, camera_faults, hang]
SHORT = [cold_boot, *STAY_UP, power_cut]
LONG = [cold_boot, *STAY_UP, card_full, card_errors, power_cut_long]


def fly(args, wanted):
    """Runs scenarios; results by name."""
    results, flight = {}, None
    for scenario in wanted:
        name, began = scenario.__name__, time.monotonic()
        try:
            if flight is None:
                flight = Flight(args, name, **OPTIONS.get(name, {}))
                flight.take_off()
            results[name] = {"ok": True} | scenario(flight)
        except (Failure, OSError, subprocess.SubprocessError, ValueError) as error:
            results[name] = {"ok": False, "error": str(error)}
            traceback.print_exc()
        following = wanted[wanted.index(scenario) + 1:]
        stays = scenario in STAY_UP and following and following[0] in STAY_UP
        if flight is not None and not (stays and results[name]["ok"]):
            flight.end()
            flight = None
        results[name]["took_s"] = round(time.monotonic() - began)
        print(f"{'ok  ' if results[name]['ok'] else 'FAIL'} {name}: {json.dumps(results[name])}", flush=True)
        (Path(args.image) / "results.json").write_text(json.dumps(results, indent=1))
    return results


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for option in ("image", "windhover", "feed", "frames", "capture", "truth"):
        parser.add_argument(f"--{option}", required=True)
    parser.add_argument("--long", action="store_true", help="every scenario")
    parser.add_argument("scenario", nargs="*")
    args = parser.parse_args()
    every = {scenario.__name__: scenario for scenario in [*SHORT, *LONG]}
    wanted = [every[name] for name in args.scenario] or (LONG if args.long else SHORT)
    results = fly(args, wanted)
    return 0 if all(result["ok"] for result in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
