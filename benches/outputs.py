"""What each output of the daemon and of the station costs: processor and memory at 30 estimates a second; with --build the size of
the program with and without features, and the time of a cold build. Prints a table in Markdown.

    python3 benches/outputs.py target/release/windhover [--seconds 20] [--build]

Each row is a run of its own: the daemon on a simulated flight, with that output added to what the first row has, or the station that
receives it. The figures are of the whole process: an output's cost is the difference from the row it builds on. Needs what
`make test-python` installs (its environment: target/venv/bin/python)."""

import argparse
import os
import pathlib
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402

FPS = 30
OFF = "[store]\nenabled = false\n"


class Cost:
    """Processor time and memory of a process, over a while."""

    def __init__(self, pid, seconds):
        began = self.processor_s(pid)
        time.sleep(seconds)
        self.percent = 100 * (self.processor_s(pid) - began) / seconds
        status = pathlib.Path(f"/proc/{pid}/status").read_text()
        self.megabytes = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")) / 1e3

    @staticmethod
    def processor_s(pid):
        fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Listener:
    """Takes datagrams and counts their bytes."""

    def __init__(self):
        self.line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.line.bind(("127.0.0.1", 0))
        self.port, self.bytes = self.line.getsockname()[1], 0
        threading.Thread(target=self.listen, daemon=True).start()

    def listen(self):
        while True:
            self.bytes += len(self.line.recv(65_536))


def asked(port):
    """Fetches the metrics of that port once a second, as Prometheus would in a hurry."""
    def ask():
        while True:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics").read()
            except OSError:
                pass
            time.sleep(1)

    threading.Thread(target=ask, daemon=True).start()


def daemon_rows(flight, keys, seconds):
    metrics = rig.free_port(socket.SOCK_STREAM)
    mavlink, video = Listener(), Listener()
    link = rig.link_tables(keys, f"127.0.0.1:{rig.free_port()}")
    rows = [
        ("daemon, no output", OFF),
        ("+ card (JPEG of every frame)", ""),
        ("+ card without frames", '[store]\npath = "/var/lib/windhover"\nframes = "none"\n'),
        ("+ link, no station", OFF + link),
        ("+ MAVLink, 10 Hz", OFF + f'[mavlink]\nenabled = true\nsend_to = ["127.0.0.1:{mavlink.port}"]\n'),
        ("+ metrics, fetched once a second", OFF + f'[daemon]\nmetrics = "127.0.0.1:{metrics}"\n'),
        ("+ video, 15 Hz", OFF + f'[video]\nsend_to = ["127.0.0.1:{video.port}"]\n'),
    ]
    asked(metrics)
    for name, tables in rows:
        daemon = rig.Daemon(flight, tables)
        try:
            daemon.wait("event=target_tracking", seconds=120)
            time.sleep(2)
            yield name, Cost(daemon.process.pid, seconds)
        finally:
            daemon.stop()
    print(f"(video: {8 * video.bytes / 1e6 / (seconds + 4):.1f} Mbit/s)", file=sys.stderr)


def station_rows(flight, keys, at, seconds):
    listener, tcp = Listener(), socket.SOCK_STREAM
    rows = [
        ("station", []),
        ("+ page", ["--web", f"127.0.0.1:{rig.free_port(tcp)}"]),
        ("+ Cursor on Target", ["--cot", f"udp://127.0.0.1:{listener.port}"]),
        ("+ NMEA", ["--nmea", f"127.0.0.1:{rig.free_port(tcp)}"]),
        ("+ Foxglove, no client", ["--foxglove", f"127.0.0.1:{rig.free_port(tcp)}"]),
    ]
    port = rig.free_port()
    daemon = rig.Daemon(flight, rig.link_tables(keys / "of-station", f"127.0.0.1:{port}"))
    try:
        daemon.wait("event=target_tracking", seconds=120)
        for number, (name, words) in enumerate(rows):
            station = rig.station(keys / "of-station", f"127.0.0.1:{port}", at / f"ground{number}", *words, binary=rig.BINARY)
            try:
                time.sleep(5)
                yield name, Cost(station.pid, seconds)
            finally:
                station.terminate()
                station.wait()
    finally:
        daemon.stop()


def build_rows(at):
    for features in ("", "zenoh"):
        target = at / f"target-{features}"
        began = time.monotonic()
        words = ["cargo", "build", "--release", "--locked", "--bin", "windhover", "--features", features]
        words += ["--config", "profile.release.strip=true"]
        subprocess.run(words, cwd=ROOT, check=True, env={**os.environ, "CARGO_TARGET_DIR": str(target)})
        size = (target / "release/windhover").stat().st_size / 1e6
        yield features or "default", size, (time.monotonic() - began) / 60
        shutil.rmtree(target)


def main():
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("binary", type=pathlib.Path)
    words.add_argument("--seconds", type=float, default=20)
    words.add_argument("--scale", type=float, default=1.0, help="of the frames' size, 1280 by 1024")
    words.add_argument("--build", action="store_true", help="builds the program twice from nothing")
    asked_for = words.parse_args()
    rig.BINARY = asked_for.binary.resolve()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors, {time.strftime('%-d %B %Y, %H:%M')}\n")
    with tempfile.TemporaryDirectory() as folder:
        at = pathlib.Path(folder)
        flight = rig.Flight(seconds=30, fps=FPS, scale=asked_for.scale)
        print("| process | one core, % | memory, MB |\n|---|---|---|")
        for rows in (daemon_rows(flight, at / "keys", asked_for.seconds), station_rows(flight, at / "keys", at, asked_for.seconds)):
            for name, cost in rows:
                print(f"| {name} | {cost.percent:.1f} | {cost.megabytes:.0f} |", flush=True)
        flight.close()
        if asked_for.build:
            print("\n| features | program, MB | cold build, min |\n|---|---|---|")
            for name, size, minutes in build_rows(at):
                print(f"| {name} | {size:.1f} | {minutes:.1f} |", flush=True)


if __name__ == "__main__":
    main()
