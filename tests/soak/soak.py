"""Everything that goes wrong at once, for an hour: hostile strangers, readers that read nothing, devices and a card that come
and go, a station that is killed. Memory stays flat, nothing is lost but what is reported.

`make soak` runs it; `make soak SOAK_S=120` for two minutes.
"""

import argparse
import os
import pathlib
import pty
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402
from mcap.exceptions import McapError  # noqa: E402
from mcap.records import Message  # noqa: E402
from mcap.stream_reader import StreamReader  # noqa: E402

# Memory may grow by so much from when everything has been seen once (a fifth of the time) to the end: the page's trails and
# the flight's index grow with the flight by some megabytes an hour.
GROWTH = 1.25
MARGIN_MB = 12


def heap_of_the_unit():
    """The heap that the payload is deployed with: without it each thread has a heap of its own, and each opening of the
    index leaves its pages in others (docs/daemon.md)."""
    unit = (ROOT / "systemd/windhover.service").read_text()
    return dict(re.findall(r"^Environment=(MALLOC_\w+)=(\d+)$", unit, re.MULTILINE))


class FlappingDaemon(rig.Daemon):
    """A payload whose serial lines are links to pseudo-terminals, which are exchanged for others."""

    def __init__(self, flight, tables):
        self.lock = threading.Lock()
        super().__init__(flight, tables)
        text = (self.at / "windhover.toml").read_text()
        self.links = {}
        names = re.findall(r'"(/dev/pts/\d+)"', text)
        for source, name in zip(("gps", "compass"), names, strict=True):
            self.links[source] = self.at / source
            self.links[source].symlink_to(name)
            text = text.replace(f'"{name}"', f'"{self.links[source]}"')
        self.stop_process()
        (self.at / "windhover.toml").write_text(text)
        self.start_process()

    def start_process(self):
        with open(self.log, "ab") as log:
            words = [rig.BINARY, "run", "--config", self.at / "windhover.toml"]
            environment = {**os.environ, **heap_of_the_unit()}
            self.process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stderr=log, env=environment)

    def stop_process(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(20)

    def feed(self, flight):
        while not self.stopped.is_set():
            began = time.monotonic()
            for at, source, data in flight.serial:
                if self.stopped.wait(max(0.0, began + at - time.monotonic())):
                    return
                with self.lock:
                    try:
                        os.set_blocking(self.ends[source], False)
                        os.write(self.ends[source], data)
                    except OSError:
                        # Nobody reads just now, or the device is unplugged.
                        pass

    def unplug(self, source, dice):
        """The device goes and comes back under another name, with rubbish first."""
        far, near = pty.openpty()
        tty.setraw(near)
        name = os.ttyname(near)
        with self.lock:
            os.close(self.ends[source])
            self.links[source].unlink()
        time.sleep(dice.uniform(0.5, 3.0))
        with self.lock:
            self.links[source].symlink_to(name)
            self.ends[source] = far
            os.write(far, dice.randbytes(400))
        os.close(near)


def kept(folder):
    """Numbers that a station keeps, by flight. Segments of a station that was killed end in the middle of a chunk."""
    numbers = {}
    for path in sorted(folder.glob("*/*/*.mcap")):
        kept = numbers.setdefault(path.parent.name, [])
        with open(path, "rb") as file:
            try:
                kept.extend(r.sequence for r in StreamReader(file).records if isinstance(r, Message))
            except (McapError, EOFError, ValueError):
                pass
    return {flight: found for flight, found in numbers.items() if found}


def resident_mb(pid):
    status = pathlib.Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", status).group(1)) / 1e3


def descriptors(pid):
    return len(list(pathlib.Path(f"/proc/{pid}/fd").iterdir()))


class Soak:
    def __init__(self, seconds, seed):
        self.dice, self.end = random.Random(seed), time.monotonic() + seconds
        self.seconds = seconds
        self.folder = tempfile.TemporaryDirectory()
        self.at = pathlib.Path(self.folder.name)
        self.flight = rig.Flight()
        self.port = rig.free_port()
        self.web, self.nmea = rig.free_port(socket.SOCK_STREAM), rig.free_port(socket.SOCK_STREAM)
        self.daemon = FlappingDaemon(self.flight, rig.link_tables(self.at / "keys", f"127.0.0.1:{self.port}"))
        self.card = self.daemon.at / "card"
        self.station = self.new_station()
        self.held, self.figures = [], {"payload": [], "station": []}

    def new_station(self):
        serve = ["--web", f"127.0.0.1:{self.web}", "--nmea", f"127.0.0.1:{self.nmea}"]
        return rig.station(self.at / "keys", f"127.0.0.1:{self.port}", self.at / "ground", *serve)

    # What goes wrong.

    def strangers(self):
        """Noise at the link's port, half of it dressed as QUIC's first packet."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for n in range(2_000):
                head = b"\xc0\x00\x00\x00\x01\x08" if n % 2 else b""
                stranger.sendto(head + self.dice.randbytes(self.dice.randrange(1_200)), ("127.0.0.1", self.port))

    def silent_visitors(self):
        """Connections that ask nothing, and readers that read nothing."""
        for _ in range(60):
            for port in (self.web, self.nmea):
                visitor = socket.socket()
                visitor.settimeout(2)
                try:
                    visitor.connect(("127.0.0.1", port))
                    if self.dice.random() < 0.5:
                        visitor.sendall(b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\n" + self.dice.randbytes(40))
                    self.held.append(visitor)
                except OSError:
                    visitor.close()
        while len(self.held) > 300:
            self.held.pop(0).close()

    def unplug(self):
        self.daemon.unplug(self.dice.choice(["gps", "compass"]), self.dice)

    def pull_the_card(self):
        away = self.card.with_name("card.away")
        self.card.rename(away)
        time.sleep(self.dice.uniform(1, 8))
        # Where the daemon made a directory of its own meanwhile, it goes beside.
        if self.card.exists():
            self.card.rename(self.card.with_name(f"card.{self.dice.randrange(10**9)}"))
        away.rename(self.card)

    def kill_the_station(self):
        self.station.send_signal(signal.SIGKILL)
        self.station.wait()
        time.sleep(self.dice.uniform(0, 5))
        self.station = self.new_station()

    def measure(self):
        for name, process in (("payload", self.daemon.process), ("station", self.station)):
            if process.poll() is not None:
                raise AssertionError(f"the {name} ended: {process.returncode}\n{self.daemon.text()[-3000:]}")
            done = 1 - (self.end - time.monotonic()) / self.seconds
            self.figures[name].append((done, resident_mb(process.pid), descriptors(process.pid)))

    def run(self):
        trouble = [self.strangers, self.silent_visitors, self.unplug, self.pull_the_card, self.kill_the_station]
        self.daemon.wait("event=ready", seconds=60)
        while time.monotonic() < self.end:
            self.dice.choice(trouble)()
            time.sleep(self.dice.uniform(1, 6))
            self.measure()

    # What must hold.

    def judge(self):
        wrong = []
        for name, figures in self.figures.items():
            settled = [mb for done, mb, _ in figures if 0.15 < done < 0.4] or [figures[0][1]]
            late = [mb for done, mb, _ in figures if done > 0.8] or [figures[-1][1]]
            before, after = sorted(settled)[len(settled) // 2], sorted(late)[len(late) // 2]
            most = max(fds for _, _, fds in figures)
            print(f"{name}: {before:.1f} MB settled, {after:.1f} MB at the end, {most} descriptors at most")
            if after > GROWTH * before + MARGIN_MB:
                wrong.append(f"the {name} grew from {before:.1f} to {after:.1f} MB")
        # Left alone, the station completes what the payload still has; each number is there once.
        time.sleep(20)
        self.station.terminate()
        self.station.wait()
        numbers = kept(self.at / "ground")
        for flight, found in numbers.items():
            if len(found) != len(set(found)):
                wrong.append(f"{flight}: {len(found) - len(set(found))} records are kept twice")
            # Numbers that the payload no longer has are shown on the page as lost on board.
            print(f"{flight}: {len(found)} records of {max(found) + 1}")
        events = re.findall(r"event=(\w+)", self.daemon.text())
        print("reported:", {name: events.count(name) for name in sorted(set(events)) if name != "health"})
        for name in ("task_failed", "task_silent"):
            if name in events:
                wrong.append(f"{name} was reported")
        if not numbers:
            wrong.append("the station kept nothing")
        return wrong

    def close(self):
        for visitor in self.held:
            visitor.close()
        if self.station.poll() is None:
            self.station.kill()
        self.daemon.stop()
        self.flight.close()
        self.folder.cleanup()


def main():
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=float, default=3_600)
    arguments.add_argument("--seed", type=int, default=1)
    given = arguments.parse_args()
    soak = Soak(given.seconds, given.seed)
    try:
        soak.run()
        wrong = soak.judge()
    finally:
        soak.close()
    for line in wrong:
        print(f"WRONG {line}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
