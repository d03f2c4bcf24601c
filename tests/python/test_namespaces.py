"""Payload and station in two network namespaces, joined by a wire that can be cut and made slow.

Needs root and a kernel with namespaces, veth, nftables and tbf; says so and is skipped elsewhere.
"""

import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
import unittest

import rig

AIR, GROUND = "10.77.0.1", "10.77.0.2"
LINK = 7447


def run(*words):
    done = subprocess.run([*map(str, words)], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, words))}: {done.stderr.strip()}")
    return done.stdout


class Wire:
    """Two namespaces and what joins them."""

    def __init__(self):
        self.names = [f"wh-air-{os.getpid()}", f"wh-ground-{os.getpid()}"]
        self.ends = [f"wha{os.getpid()}", f"whg{os.getpid()}"]
        try:
            for name in self.names:
                run("ip", "netns", "add", name)
            air, ground = zip(self.names, self.ends)
            run("ip", "link", "add", air[1], "netns", air[0], "type", "veth", "peer", "name", ground[1],
                "netns", ground[0])
            for (name, end), address in zip((air, ground), (AIR, GROUND)):
                run(*self.inside(name), "ip", "address", "add", f"{address}/24", "dev", end)
                run(*self.inside(name), "ip", "link", "set", "lo", "up")
                run(*self.inside(name), "ip", "link", "set", end, "up")
                # So that a scan is answered at once; a kernel without one of these answers more slowly.
                for limit in ("icmp_ratelimit=0", "icmp_msgs_per_sec=1000000", "icmp_msgs_burst=100000"):
                    run(*self.inside(name), "sysctl", "-eqw", f"net.ipv4.{limit}")
            run(*self.inside(air[0]), "nft", "add", "table", "inet", "wire")
            for chain in ("input", "output"):
                hook = f"{{ type filter hook {chain} priority 0; policy accept; }}"
                run(*self.inside(air[0]), "nft", "add", "chain", "inet", "wire", chain, hook)
            # The kernel must know what makes it slow before anybody relies on it.
            self.slow("1gbit")
        except (OSError, RuntimeError):
            self.close()
            raise

    @staticmethod
    def inside(name):
        return ["ip", "netns", "exec", name]

    @property
    def air(self):
        return self.inside(self.names[0])

    @property
    def ground(self):
        return self.inside(self.names[1])

    def cut(self):
        for chain in ("input", "output"):
            run(*self.air, "nft", "add", "rule", "inet", "wire", chain, "drop")

    def restore(self):
        for chain in ("input", "output"):
            run(*self.air, "nft", "flush", "chain", "inet", "wire", chain)

    def slow(self, rate):
        for inside, end in zip((self.air, self.ground), self.ends):
            run(*inside, "tc", "qdisc", "replace", "dev", end, "root", "tbf", "rate", rate, "burst", 3_000,
                "latency", "1s")

    def close(self):
        for name in self.names:
            subprocess.run(["ip", "netns", "del", name], stderr=subprocess.DEVNULL)


def lines(path):
    """(live records a second, stored, missing) of each line the station printed."""
    found = []
    for line in path.read_text().splitlines():
        if "/s live" in line and " stored, " in line:
            live = int(line.split("/s live")[0].rsplit(" ", 1)[1])
            kept, missing = line.rsplit("| ", 1)[1].split(" stored, ")
            found.append((live, int(kept), int(missing.split()[0])))
    return found


class Namespaces(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.flight = rig.Flight()
        cls.addClassCleanup(cls.flight.close)

    def setUp(self):
        if os.geteuid() != 0:
            rig.leave_out(self, "two network namespaces need root")
        if not all(map(shutil.which, ("ip", "tc", "nft"))):
            rig.leave_out(self, "two network namespaces need ip, tc and nft (Debian: iproute2, nftables)")
        try:
            self.wire = Wire()
        except RuntimeError as error:
            rig.leave_out(self, f"this kernel or container does not allow it: {error}")
        self.addCleanup(self.wire.close)
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.at = pathlib.Path(folder.name)
        tables = rig.link_tables(self.at / "keys", f"{AIR}:{LINK}")
        self.daemon = rig.Daemon(self.flight, tables, inside=self.wire.air)
        self.addCleanup(self.daemon.stop)
        self.daemon.wait("event=ready")

    def test_live_a_cut_a_slow_line_and_nothing_missing(self):
        # Given: a station that receives.
        said = self.at / "said"
        with open(said, "wb") as out:
            station = rig.station(
                self.at / "keys", f"{AIR}:{LINK}", self.at / "ground", "--no-web", "--no-thumbnails",
                inside=self.wire.ground, stdout=out,
            )
        self.addCleanup(station.wait)
        self.addCleanup(station.kill)
        latest = lambda: (lines(said) or [(0, 0, 0)])[-1]  # noqa: E731
        self.until(lambda: latest()[0] >= 15, "it is live", said)
        # When: the wire is cut for 6 s.
        self.wire.cut()
        self.until(lambda: latest()[0] == 0, "nothing passes", said)
        at_cut = latest()[1]
        time.sleep(6)
        self.assertEqual(latest()[1], at_cut)
        self.wire.restore()
        # Then: it is live within two lines, and what was missed comes.
        count = len(lines(said))
        self.until(lambda: latest()[0] >= 10, "it is live again", said)
        self.assertLessEqual(len(lines(said)) - count, 4, lines(said)[count:])
        self.until(lambda: latest()[2] == 0 and latest()[1] > at_cut + 60, "the cut is filled", said)
        # When: the line carries 48 kbit/s, then estimates come again every second once that is found out.
        self.wire.slow("48kbit")
        count = len(lines(said))
        slow = lambda: [live for live, _, _ in lines(said)[count + 3:]][-5:]  # noqa: E731
        self.until(lambda: len(slow()) == 5 and min(slow()) > 0, "it is live on a slow line", said)
        # When: it widens again and the payload stops after a while.
        self.wire.slow("1gbit")
        self.until(lambda: latest()[0] >= 15 and latest()[2] == 0, "everything came", said)
        station.terminate()
        station.wait()
        # Then: each number is there once, none missing but the youngest few.
        numbers, states = rig.kept(self.at / "ground")
        (flight,) = numbers.values()
        self.assertEqual(len(flight), len(set(flight)), "none twice")
        missing = set(range(max(flight))) - set(flight)
        self.assertFalse({n for n in missing if n < max(flight) - 100}, "none missing")
        self.assertGreater(states, 200)

    def test_a_scan_finds_only_what_is_configured(self):
        resident = lambda: int((pathlib.Path(f"/proc/{self.daemon.process.pid}/status").read_text())  # noqa: E731
                               .split("VmRSS:")[1].split()[0])
        before = resident()
        scan = pathlib.Path(__file__).with_name("scan.py")
        found = json.loads(run(*self.wire.ground, sys.executable, scan, AIR))
        self.assertEqual(found, {"tcp": [], "udp": [LINK]})
        # Then: what the strangers sent cost nothing, and the daemon flies on.
        self.assertLess(resident() - before, 16_384, "KiB more than before")
        self.daemon.wait("event=health")
        self.assertIsNone(self.daemon.process.poll())

    def until(self, what, words, said):
        rig.until(what, 60, lambda: f"not seen: {words}; {lines(said)[-8:]}")


if __name__ == "__main__":
    unittest.main()
