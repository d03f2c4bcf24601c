"""Other people's programs against a flying payload and its station: gpsd, GDAL, MAVProxy, from their packages.

`make test-clients` runs it.
"""

import json
import pathlib
import shutil
import socket
import subprocess
import sys
import tempfile
import unittest
import urllib.request

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402


class Clients(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        # Given: a payload that flies and sends MAVLink, a station with its page and its NMEA.
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.at = pathlib.Path(folder.name)
        cls.flight = rig.Flight()
        cls.addClassCleanup(cls.flight.close)
        port, cls.mavlink = rig.free_port(), rig.free_port()
        cls.web, cls.nmea = rig.free_port(socket.SOCK_STREAM), rig.free_port(socket.SOCK_STREAM)
        tables = rig.link_tables(cls.at / "keys", f"127.0.0.1:{port}")
        tables += f'[mavlink]\nenabled = true\nsend_to = ["127.0.0.1:{cls.mavlink}"]\nsystem_id = 77\n'
        daemon = rig.Daemon(cls.flight, tables)
        cls.addClassCleanup(daemon.stop)
        serve = ["--web", f"127.0.0.1:{cls.web}", "--nmea", f"127.0.0.1:{cls.nmea}"]
        station = rig.station(cls.at / "keys", f"127.0.0.1:{port}", cls.at / "ground", *serve)
        cls.addClassCleanup(station.wait)
        cls.addClassCleanup(station.terminate)
        rig.until(lambda: rig.listens(cls.nmea), 60, lambda: "the station serves no NMEA")
        rig.until(lambda: "Point" in cls.fetch("vehicles.geojson"), 120, lambda: cls.fetch("vehicles.geojson"))

    @classmethod
    def fetch(cls, name):
        with urllib.request.urlopen(f"http://127.0.0.1:{cls.web}/{name}") as answer:
            return answer.read().decode()

    def need(self, program):
        if not shutil.which(program):
            rig.leave_out(self, f"{program} is not installed")

    def test_gpsd_has_a_3d_fix_of_the_vehicle(self):
        self.need("gpsd")
        self.need("gpspipe")
        port = rig.free_port(socket.SOCK_STREAM)
        gpsd = subprocess.Popen(
            ["gpsd", "-N", "-n", "-b", "-S", str(port), f"tcp://127.0.0.1:{self.nmea}"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        self.addCleanup(gpsd.wait)
        self.addCleanup(gpsd.terminate)
        rig.until(lambda: rig.listens(port), 20, lambda: "gpsd does not listen")

        def fix():
            words = ["gpspipe", "-w", "-n", "20", f"127.0.0.1:{port}"]
            said = subprocess.run(words, capture_output=True, text=True, timeout=60).stdout
            reports = [json.loads(line) for line in said.splitlines()]
            return next((r for r in reports if r["class"] == "TPV" and r.get("mode") == 3), None)

        report = rig.until(fix, 90, lambda: "no 3D fix")
        # The simulated ground lies 33 m above the sea, the geoid 27 m below the ellipsoid.
        self.assertAlmostEqual(report["altMSL"], 33.0, delta=3.0)
        self.assertAlmostEqual(report["geoidSep"], -27.0, delta=1.0)
        self.assertAlmostEqual(report["lat"], 30.07, delta=0.01)

    def test_gdal_reads_what_the_station_serves(self):
        self.need("ogrinfo")
        for name in ("vehicles.geojson", "vehicles.kml"):
            path = self.at / name
            rig.until(lambda: "LineString" in self.fetch(name), 60, lambda: self.fetch(name))
            path.write_text(self.fetch(name))
            run = subprocess.run(["ogrinfo", "-ro", "-al", path], capture_output=True, text=True)
            self.assertEqual(run.returncode, 0, run.stderr)
            self.assertIn("LINESTRING", run.stdout, name)
            self.assertNotIn("ERROR", run.stderr, name)

    def test_mavproxy_knows_the_vehicle(self):
        mavproxy = pathlib.Path(sys.executable).with_name("mavproxy.py")
        if not mavproxy.exists():
            rig.leave_out(self, "MAVProxy is not installed")
        words = [sys.executable, mavproxy, f"--master=udpin:127.0.0.1:{self.mavlink}", "--non-interactive",
                 "--default-modules=", "--target-system=77", f"--state-basedir={self.at}"]
        out = self.at / "mavproxy.txt"
        with open(out, "wb") as file:
            run = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, cwd=self.at)
        self.addCleanup(run.wait)
        self.addCleanup(run.terminate)
        said = lambda: out.read_text(errors="replace")  # noqa: E731
        rig.until(lambda: "Detected vehicle 77" in said(), 60, said)


if __name__ == "__main__":
    unittest.main()
