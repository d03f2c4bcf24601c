"""The film of `export --format klv-ts` opened by others: ffmpeg, `stanag4609`'s verifier, `tstrans`, `klvdata`. Figures are held
against the flight's CSV, within what the standard's figures resolve."""

import csv
import io
import json
import math
import pathlib
import shutil
import subprocess
import sys
import tempfile
import unittest

import klvdata
import numpy as np
from stanag4609.st0903_geo import decode_location, decode_velocity
from stanag4609.st0903_tracker import decode_vtracker_local_set
from tstrans import klv
from tstrans.io import parse_file

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402

METRES = 111_320.0


def checksum(packet):
    """ST 0601: the sum of all 16-bit words up to the checksum's value."""
    return sum(byte << (8 if k % 2 == 0 else 0) for k, byte in enumerate(packet[:-2])) & 0xFFFF


def ber(data):
    """How many bytes the length at the begin of these takes."""
    return 1 if data[0] < 128 else 1 + (data[0] & 0x7F)


class Video(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        at = pathlib.Path(folder.name)
        rig.windhover("simulate", at / "capture.mcap", "--scenario", "follow", "--duration", 7, "--scale", 0.5)
        rig.windhover("replay", at / "capture.mcap", "--out", at / "flight.mcap")
        rig.windhover("export", at / "flight.mcap", "--format", "csv", "--out", at / "csv")
        rig.windhover("export", at / "flight.mcap", "--format", "klv-ts", "--out", at / "film")
        cls.film, cls.at = at / "film/flight.ts", at
        cls.tables = {path.stem: list(csv.DictReader(io.StringIO(path.read_text()))) for path in (at / "csv").glob("*.csv")}
        packets = [(event.pts.ms, bytes(event.payload)) for event in parse_file(str(cls.film)) if "Metadata" in type(event).__name__]
        vmti = bytes.fromhex("060e2b34020b01010e01030306000000")
        cls.packets = [(pts, packet) for pts, packet in packets if not packet.startswith(vmti)]
        cls.targets = [(pts, packet) for pts, packet in packets if packet.startswith(vmti)]

    def frames(self, name):
        return {int(row["time_ns"]): row for row in self.tables[name] if row["frame"]}

    def test_every_frame_has_its_packet_and_its_time(self):
        times = sorted(int(row["time_ns"]) for row in self.tables["estimates"])
        self.assertEqual((len(self.packets), len(self.targets)), (len(times), len(times)))
        first = times[0]
        ahead = set()
        for (pts_ms, packet), (also_ms, targets), t in zip(self.packets, self.targets, times):
            self.assertAlmostEqual(pts_ms - self.packets[0][0], (t - first) / 1e6, delta=1.0)
            for sealed in (packet, targets):
                self.assertEqual(int.from_bytes(sealed[-2:], "big"), checksum(sealed))
            self.assertEqual((also_ms, targets[-4:-2]), (pts_ms, b"\x01\x02"))
            ahead.add(klv.decode_uas_datalink(packet).timestamp_us - t // 1000)
        # UTC is a constant ahead of host time, to the microsecond.
        self.assertLessEqual(max(ahead) - min(ahead), 1)

    def test_the_platform_and_what_it_sees(self):
        own = self.frames("ownship")
        checked = 0
        for (_, packet), t in zip(self.packets, sorted(int(row["time_ns"]) for row in self.tables["estimates"])):
            said = klv.decode_uas_datalink(packet)
            if t not in own or said.sensor_lat_deg is None:
                continue
            checked += 1
            row = {name: float(value) for name, value in own[t].items()}
            w, x, y, z = (row[name] for name in ("qw", "qx", "qy", "qz"))
            heading = math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
            self.assertAlmostEqual(math.remainder(said.platform_heading_deg - heading, 360), 0, delta=0.003)
            self.assertAlmostEqual(said.platform_pitch_full_deg, math.degrees(math.asin(2 * (w * y - z * x))), delta=1e-6)
            # The camera stands some decimetres from the body frame's origin.
            north = (said.sensor_lat_deg - row["lat_deg"]) * METRES
            east = (said.sensor_lon_deg - row["lon_deg"]) * METRES * math.cos(math.radians(row["lat_deg"]))
            self.assertLess(math.hypot(north, east), 0.5)
            self.assertAlmostEqual(said.sensor_ellipsoid_height_m, row["height_m"], delta=0.5)
            if said.frame_center_lat_deg is not None and said.corner_lat_p1_deg is not None:
                corners = [(getattr(said, f"corner_lat_p{k}_deg"), getattr(said, f"corner_lon_p{k}_deg")) for k in (1, 2, 3, 4)]
                middle = np.mean(corners, axis=0) - [said.frame_center_lat_deg, said.frame_center_lon_deg]
                self.assertLess(np.hypot(*middle) * METRES, 0.3 * said.slant_range_m)
        self.assertGreater(checked, 80)

    def test_the_targets_are_those_of_the_table(self):
        rows = sorted(self.tables["estimates"], key=lambda row: int(row["time_ns"]))
        checked = 0
        for (_, packet), row in zip(self.targets, rows):
            said = klv.decode_vmti(packet[16 + ber(packet[16:]) :])
            if not row["north_m"]:
                self.assertEqual(len(said.targets), 0)
                continue
            checked += 1
            (target,) = said.targets
            place = decode_location(target.target_location)
            north = (place.latitude - float(row["lat_deg"])) * METRES
            east = (place.longitude - float(row["lon_deg"])) * METRES * math.cos(math.radians(place.latitude))
            # Four bytes of latitude are 1.4 cm, of longitude twice as much.
            self.assertLess(math.hypot(north, east), 0.03)
            # Sigmas come in steps of 1/32 m, speeds of 1/16 m/s.
            self.assertAlmostEqual(place.sigma_east, math.sqrt(float(row["p_ee"])), delta=1 / 32)
            self.assertAlmostEqual(place.sigma_north, math.sqrt(float(row["p_nn"])), delta=1 / 32)
            velocity = decode_vtracker_local_set(target.vtracker).velocity
            speed, heading = float(row["speed_mps"]), float(row["heading_rad"])
            self.assertAlmostEqual(velocity.east, speed * math.sin(heading), delta=1 / 16)
            self.assertAlmostEqual(velocity.north, speed * math.cos(heading), delta=1 / 16)
        self.assertGreater(checked, 60)

    def test_klvdata_reads_the_same(self):
        for _, packet in self.packets[::10]:
            (parsed,) = list(klvdata.StreamParser(packet))
            items = parsed.MetadataList()
            self.assertEqual(items[10][3], "windhover")
            said = klv.decode_uas_datalink(packet)
            if 13 in items:
                self.assertAlmostEqual(float(items[13][3]), said.sensor_lat_deg, delta=1e-6)

    def test_the_standards_verifier_finds_no_fault(self):
        verify = pathlib.Path(sys.executable).with_name("stanag4609-verify")
        words = [verify, "--no-require-security", "--format", "json", self.film]
        run = subprocess.run(words, capture_output=True, text=True)
        report = json.loads(run.stdout)
        self.assertEqual([finding for finding in report["findings"] if finding["status"] in ("error", "fail")], [])
        self.assertEqual(report["result"].lower(), "pass")
        counted = [report["metadata"][name] for name in ("st0601_packets", "st0903_packets", "unknown_klv_packets")]
        self.assertEqual(counted, [len(self.packets), len(self.packets), 0])

    def test_ffmpeg_plays_it(self):
        if not shutil.which("ffprobe"):
            rig.leave_out(self, "ffmpeg is not installed")
        words = ["ffprobe", "-v", "error", "-count_frames", "-show_streams", "-of", "json", self.film]
        streams = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)["streams"]
        video, data = streams
        self.assertEqual((video["codec_name"], video["width"], video["height"]), ("h264", 640, 512))
        self.assertEqual(int(video["nb_read_frames"]), len(self.packets))
        self.assertEqual(data["codec_name"], "klv")
        out = self.at / "out.klv"
        run = subprocess.run(["ffmpeg", "-v", "error", "-y", "-i", self.film, "-map", "0:d", "-c", "copy", "-f", "data", out], capture_output=True, text=True)
        self.assertEqual((run.returncode, run.stderr), (0, ""))
        self.assertEqual(out.read_bytes(), b"".join(a + b for (_, a), (_, b) in zip(self.packets, self.targets)))


if __name__ == "__main__":
    unittest.main()
