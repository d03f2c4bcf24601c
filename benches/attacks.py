"""Memory of a payload and of its station under strangers and readers that read nothing. Prints a table in Markdown.

    python3 benches/attacks.py target/release/windhover

The payload flies a simulated flight with the heap settings of its unit; each row is one attack and ten seconds or more after it. Needs
what `make test-python` installs (its environment: target/venv/bin/python)."""

import argparse
import os
import pathlib
import random
import re
import resource
import socket
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402

UPGRADE = ("Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
           "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n")


class Watched:
    """Memory of a process, MB."""

    def __init__(self, pid):
        self.at = pathlib.Path(f"/proc/{pid}")

    def megabytes(self, name):
        return int(re.search(rf"{name}:\s+(\d+)", (self.at / "status").read_text()).group(1)) / 1e3

    def now(self):
        return self.megabytes("VmRSS")

    def most(self):
        return self.megabytes("VmHWM")

    def forget(self):
        (self.at / "clear_refs").write_text("5")

    def descriptors(self):
        return len(list((self.at / "fd").iterdir()))


class Attacks:
    def __init__(self, link, web, nmea):
        self.link, self.web, self.nmea, self.held = link, web, nmea, []

    def hold(self, port, number, words=b""):
        for _ in range(number):
            visitor = socket.socket()
            visitor.settimeout(2)
            try:
                visitor.connect(("127.0.0.1", port))
                visitor.sendall(words)
                self.held.append(visitor)
            except OSError:
                visitor.close()

    def release(self):
        for visitor in self.held:
            visitor.close()
        self.held.clear()
        time.sleep(12)

    def nothing(self):
        time.sleep(10)

    def strangers(self):
        """Datagrams at the link, half of them dressed as QUIC's first packet."""
        dice = random.Random(1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for n in range(50_000):
                head = b"\xc0\x00\x00\x00\x01\x08" if n % 2 else b""
                stranger.sendto(head + dice.randbytes(dice.randrange(1_200)), ("127.0.0.1", self.link))

    def half_requests(self):
        self.hold(self.web, 1_100, b"GET / HTTP/1.1\r\nHost: 127")

    def nmea_readers(self):
        self.hold(self.nmea, 1_011)
        time.sleep(20)

    def stream_readers(self):
        self.hold(self.web, 64, f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{self.web}\r\n{UPGRADE}".encode())
        time.sleep(20)

    def page(self):
        """Whether the page is still served."""
        with socket.create_connection(("127.0.0.1", self.web), 5) as visitor:
            visitor.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{self.web}\r\nConnection: close\r\n\r\n".encode())
            return visitor.recv(100).startswith(b"HTTP/1.1 200")

    def sentence(self):
        """Whether the next reader gets a sentence."""
        with socket.create_connection(("127.0.0.1", self.nmea), 5) as reader:
            reader.settimeout(10)
            return reader.recv(1) == b"$"


def measure(payload, station, attacks):
    print("| attack | payload before, after, most | station before, after, most | its descriptors |\n|---|---|---|---|")
    for name in ("nothing", "strangers", "half_requests", "nmea_readers", "stream_readers"):
        before = [watched.now() for watched in (payload, station)]
        payload.forget()
        station.forget()
        getattr(attacks, name)()
        time.sleep(10)
        figures = [f"{was:.0f}, {watched.now():.0f}, {watched.most():.0f}"
                   for was, watched in zip(before, (payload, station), strict=True)]
        print(f"| {name} | {figures[0]} | {figures[1]} | {station.descriptors()} |", flush=True)
        attacks.release()
        if not (attacks.page() and attacks.sentence()):
            sys.exit(f"after {name} the station does not serve")


def main():
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("binary", type=pathlib.Path)
    rig.BINARY = words.parse_args().binary.resolve()
    resource.setrlimit(resource.RLIMIT_NOFILE, (4_096, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    unit = (ROOT / "systemd/windhover.service").read_text()
    os.environ.update(re.findall(r"^Environment=(MALLOC_\w+)=(\d+)$", unit, re.MULTILINE))
    with tempfile.TemporaryDirectory() as folder:
        at, flight = pathlib.Path(folder), rig.Flight()
        link, tcp = rig.free_port(), socket.SOCK_STREAM
        web, nmea = rig.free_port(tcp), rig.free_port(tcp)
        daemon = rig.Daemon(flight, rig.link_tables(at / "keys", f"127.0.0.1:{link}"))
        serve = ["--web", f"127.0.0.1:{web}", "--nmea", f"127.0.0.1:{nmea}"]
        station = rig.station(at / "keys", f"127.0.0.1:{link}", at / "ground", *serve, binary=rig.BINARY)
        try:
            daemon.wait("event=ready")
            time.sleep(40)
            measure(Watched(daemon.process.pid), Watched(station.pid), Attacks(link, web, nmea))
        finally:
            station.terminate()
            station.wait()
            daemon.stop()
            flight.close()


if __name__ == "__main__":
    main()
