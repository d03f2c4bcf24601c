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
from pathlib import Path

from compare import compare, demand
from machine import Failure, Feed, Machine

# Emulation is some ten times slower than the host: limits are for function, not speed.
READY_S = 240
ESTIMATE_S = 120
POSITION_M = 4.0
HEADING_DEG = 12.0


class Bench:
    """What every scenario is given."""

    def __init__(self, args):
        self.args = args
        self.image = Path(args.image)
        text = subprocess.run([args.windhover, "check-config", str(args.config)], check=True,
                              capture_output=True, text=True).stdout if args.config else None
        self.config = text
        self.figures = {}

    def machine(self, name, **options):
        return Machine(self.image, self.image / name, **options)

    def feed(self, machine):
        return Feed(machine, self.args.feed, self.args.capture)

    def up(self, machine):
        """Boots, feeds, waits until the daemon is ready; the feed."""
        machine.boot()
        machine.wait_for_control()
        feed = self.feed(machine)
        wait_ready(machine)
        return feed


def wait_ready(machine):
    limit = time.monotonic() + READY_S
    while machine.service("ActiveState") != "active":
        if time.monotonic() > limit:
            raise Failure(f"not ready after {READY_S} s:\n" + machine.run("systemctl status windhover; true")
                          + "\n" + "\n".join(machine.journal().splitlines()[-15:]))
        time.sleep(1)


def wait_tracking(machine, seconds=ESTIMATE_S):
    return machine.wait_journal(["health ", "ugv=tracking"], seconds)


def cold_boot(bench):
    """From power on to ready, to an estimate, to a flight on the card that agrees with the truth."""
    machine = bench.machine("cold_boot")
    try:
        feed = bench.up(machine)
        ready = machine.since_boot()
        wait_tracking(machine)
        estimate = machine.since_boot()
        # The sandbox holds on a real boot: no root, nothing writable but the card, devices open.
        demand(machine.run("ps -o user= -C windhover").split() == ["windhover"], "the daemon runs as root")
        demand(machine.run("findmnt -no OPTIONS / | tr , '\\n' | grep -x ro") == "ro", "the root is writable")
        ports = machine.run("ss -Hlnutp | grep -c windhover; true")
        demand(ports == "0", f"{ports} open ports that nobody configured")
        while feed.running() and machine.since_boot() < estimate + 40:
            time.sleep(1)
        memory = machine.service("MemoryCurrent")
        began = time.monotonic()
        machine.run("systemctl stop windhover", 30)
        stopped = time.monotonic() - began
        result = machine.service("Result")
        demand(result == "success", f"stopping ended with {result}")
        feed.stop()
        machine.shut_down()
        flights = machine.flights()
        demand(flights, "no flight on the card")
        figures = compare(bench.args.windhover, bench.args.frames, flights[-1], bench.args.truth, machine.work)
        figures |= {"ready_s": round(ready, 1), "first_estimate_s": round(estimate, 1),
                    "stop_s": round(stopped, 2), "memory_mb": round(int(memory) / 1e6, 1)}
        demand(figures["compared"] >= 20, f"too few estimates to compare: {figures}")
        demand(figures["position_m"] < POSITION_M, f"position is off: {figures}")
        demand(figures["heading_deg"] < HEADING_DEG, f"heading is off: {figures}")
        return figures
    finally:
        machine.stop()


def unplug(bench):
    """Each device goes away and comes back; each is told, none ends the daemon."""
    machine = bench.machine("unplug")
    try:
        feed = bench.up(machine)
        pid = machine.service("MainPID")
        for part in ("gps", "compass"):
            after = len(machine.journal().splitlines())
            slot = machine.unplug_serial(part)
            machine.wait_journal(["device_down", f"about={part}"], 30, after)
            time.sleep(3)
            machine.plug_serial(slot)
            machine.wait_journal(["device_up", f"about={part}"], 60, after)
        # The camera: vivid's own control makes it vanish for a while.
        after = len(machine.journal().splitlines())
        machine.run("v4l2-ctl -d /dev/video0 -c disconnect=1", check=False)
        machine.wait_journal(["device_down", "about=camera"], 60, after)
        machine.wait_journal(["device_up", "about=camera"], 120, after)
        demand(machine.service("MainPID") == pid, "the daemon was started again")
        feed.stop()
        return {"pid": int(pid)}
    finally:
        machine.stop()


def camera_faults(bench):
    """Errors, lost and wrongly stamped buffers by the driver's own fault injection."""
    machine = bench.machine("camera_faults")
    try:
        feed = bench.up(machine)
        pid = machine.service("MainPID")
        seen = {}
        for control, words in (("percentage_of_dropped_buffers=60", "camera_frames_missed"),
                               ("inject_dqbuf_error=1", None), ("inject_buf_queue_error=1", None)):
            name = control.split("=")[0]
            after = len(machine.journal().splitlines())
            machine.run(f"v4l2-ctl -d /dev/video0 -c {control}", check=False)
            if words:
                machine.wait_journal([words], 60, after)
            time.sleep(6)
            machine.run("v4l2-ctl -d /dev/video0 -c percentage_of_dropped_buffers=0", check=False)
            time.sleep(10)
            line, _ = machine.wait_journal(["health "], 30, len(machine.journal().splitlines()))
            rate = float(re.search(r"camera_hz=([0-9.]+)", line).group(1))
            demand(rate > 0, f"no frames after {name}: {line}")
            seen[name] = rate
        demand(machine.service("MainPID") == pid, "the daemon was started again")
        feed.stop()
        return seen
    finally:
        machine.stop()


def hang(bench):
    """A daemon that hangs: the watchdog has the daemon started again, and it is ready again."""
    machine = bench.machine("hang")
    try:
        feed = bench.up(machine)
        pid = machine.service("MainPID")
        # SIGSTOP stops every thread of the process, not one task alone: the watchdog is no longer stroked.
        machine.run(f"kill -STOP {pid}")
        began = time.monotonic()
        while machine.service("MainPID") in (pid, "0"):
            demand(time.monotonic() - began < 90, "the watchdog did not end the hung daemon")
            time.sleep(1)
        took = time.monotonic() - began
        wait_ready(machine)
        feed.stop()
        return {"restarted_after_s": round(took, 1)}
    finally:
        machine.stop()


def power_cut(bench, cuts=2):
    """Power goes at random moments; every boot afterwards seals what was cut and flies again."""
    machine = bench.machine("power_cut")
    kept = []
    try:
        for _ in range(cuts):
            feed = bench.up(machine)
            time.sleep(random.uniform(5, 20))
            # What the daemon says is on the card has to be there after the cut.
            line = machine.run("cat /proc/uptime; journalctl -u windhover -o cat -n 1 --no-pager")
            machine.power_cut()
            feed.stop()
            kept.append(line.splitlines()[0])
        feed = bench.up(machine)
        machine.run("systemctl stop windhover", 30)
        feed.stop()
        machine.shut_down()
        flights = machine.flights()
        demand(len(flights) >= cuts, f"{len(flights)} flights after {cuts} cuts")
        sizes = {}
        for flight in flights:
            seen = subprocess.run([bench.args.frames, str(flight)], check=True, capture_output=True, text=True)
            sizes[flight.name] = len(seen.stdout.splitlines()) - 1
        demand(all(frames > 0 for frames in list(sizes.values())[:cuts]), f"a flight is empty: {sizes}")
        return {"flights": sizes}
    finally:
        machine.stop()


def card_full(bench):
    """A card too small for the flight: that is told, estimates go on, and the daemon lives."""
    machine = bench.machine("card_full", card_mb=48)
    try:
        feed = bench.up(machine)
        machine.wait_journal(["recording_stopped"], 240)
        pid = machine.service("MainPID")
        line, _ = machine.wait_journal(["health "], 30, len(machine.journal().splitlines()))
        demand("camera_hz=0.0" not in line, f"no frames: {line}")
        demand(machine.service("MainPID") == pid, "the daemon was started again")
        feed.stop()
        return {"health": line[-200:]}
    finally:
        machine.stop()


def card_errors(bench):
    """The card answers with I/O errors (dm-flakey) for a while, and is used again afterwards."""
    machine = bench.machine("card_errors")
    try:
        feed = bench.up(machine)
        pid = machine.service("MainPID")
        machine.run("systemctl stop windhover && umount /var/lib/windhover && modprobe dm-flakey", 60)
        sectors = machine.run("blockdev --getsz /dev/sda")
        machine.run(f"echo 0 {sectors} linear /dev/sda 0 | dmsetup create card")
        machine.run("mount /dev/mapper/card /var/lib/windhover && systemctl start --no-block windhover", 60)
        wait_ready(machine)
        pid = machine.service("MainPID")
        after = len(machine.journal().splitlines())
        machine.run(f"echo 0 {sectors} error | dmsetup reload card && dmsetup suspend --nolockfs --noflush card "
                    "&& dmsetup resume card")
        machine.wait_journal(["recording_stopped"], 90, after)
        line, _ = machine.wait_journal(["health "], 30, len(machine.journal().splitlines()))
        demand("camera_hz=0.0" not in line, f"no frames: {line}")
        demand(machine.service("MainPID") == pid, "the daemon was started again")
        feed.stop()
        return {"health": line[-200:]}
    finally:
        machine.stop()


SHORT = [cold_boot, unplug, power_cut]
LONG = [*SHORT, hang, camera_faults, card_full, card_errors, lambda bench: power_cut(bench, 10)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for option in ("image", "windhover", "feed", "frames", "capture", "truth"):
        parser.add_argument(f"--{option}", required=True)
    parser.add_argument("--config")
    parser.add_argument("--long", action="store_true")
    parser.add_argument("scenario", nargs="*")
    args = parser.parse_args()
    every = {scenario.__name__: scenario for scenario in LONG if scenario.__name__ != "<lambda>"}
    wanted = [every[name] for name in args.scenario] or (LONG if args.long else SHORT)
    bench, results, failed = Bench(args), {}, 0
    for scenario in wanted:
        name = scenario.__name__.strip("<>")
        began = time.monotonic()
        try:
            results[name] = {"ok": True} | scenario(bench)
        except (Failure, OSError, subprocess.SubprocessError, ValueError) as error:
            failed += 1
            results[name] = {"ok": False, "error": str(error)}
            traceback.print_exc()
        results[name]["took_s"] = round(time.monotonic() - began)
        print(f"{'ok  ' if results[name]['ok'] else 'FAIL'} {name}: {json.dumps(results[name])}", flush=True)
        (bench.image / "results.json").write_text(json.dumps(results, indent=1))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
