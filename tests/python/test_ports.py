"""What a running daemon lets the network reach, and what strangers' bytes cost it."""

import os
import pathlib
import random
import socket
import unittest

import rig


def sockets(pid):
    """Sockets of a process that anybody could send to: {(protocol, port)}."""
    own = set()
    for fd in pathlib.Path(f"/proc/{pid}/fd").iterdir():
        try:
            own.add(os.readlink(fd))
        except FileNotFoundError:
            continue
    found = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in pathlib.Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            # 0A is a listening TCP socket; of UDP every bound one is reachable.
            if f"socket:[{fields[9]}]" in own and (table.startswith("udp") or fields[3] == "0A"):
                found.add((table[:3], int(fields[1].rsplit(":", 1)[1], 16)))
    return found


class Ports(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.flight = rig.Flight(seconds=10)
        cls.addClassCleanup(cls.flight.close)

    def fly(self, tables):
        daemon = rig.Daemon(self.flight, tables)
        self.addCleanup(daemon.stop)
        daemon.wait("event=ready")
        return daemon

    def test_nothing_configured_nothing_open(self):
        self.assertEqual(sockets(self.fly("").process.pid), set())

    def test_only_what_is_configured_is_open_and_strangers_cost_nothing(self):
        port = rig.free_port()
        link = rig.link_tables(self.flight.at / "keys", f"127.0.0.1:{port}")
        daemon = self.fly(link + "[mavlink]\nenabled = true\n")
        pid = daemon.process.pid
        rig.until(lambda: ("udp", port) in sockets(pid), 30, lambda: f"{sockets(pid)}")
        found = sockets(pid)
        # The link's, and the one MAVLink sends from.
        self.assertEqual({kind for kind, _ in found}, {"udp"}, found)
        self.assertEqual(len(found), 2, found)

        # When: strangers send noise, half of it dressed as QUIC's first packet.
        status = lambda: pathlib.Path(f"/proc/{pid}/status").read_text()  # noqa: E731
        resident = lambda: int(status().split("VmRSS:")[1].split()[0])  # noqa: E731
        tasks = lambda: len(list(pathlib.Path(f"/proc/{pid}/task").iterdir()))  # noqa: E731
        lines = len([line for line in daemon.text().splitlines() if "event=health" not in line])
        before = resident(), tasks()
        dice = random.Random(5)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for n in range(20_000):
                noise = dice.randbytes(dice.randrange(0, 1_300))
                head = b"\xc0\x00\x00\x00\x01\x08" if n % 2 else b""
                for _, to in found:
                    stranger.sendto(head + noise, ("127.0.0.1", to))
        # Then: it keeps no more memory than before, sends almost nothing, and continues.
        daemon.wait("event=health")
        self.assertLess(resident() - before[0], 16_384, "KiB more than before")
        self.assertLessEqual(tasks(), before[1] + 2)
        said = [line for line in daemon.text().splitlines() if "event=health" not in line][lines:]
        self.assertLess(len(said), 60, said[:5])
        self.assertEqual(sockets(pid), found)
        self.assertIsNone(daemon.process.poll())


if __name__ == "__main__":
    unittest.main()
