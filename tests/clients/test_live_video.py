"""`[video]` of a flying payload, received as UDP: `ffprobe`, `stanag4609`'s verifier, `klvdata` and `tstrans` read it, figures are
held against what the flight on the card says. The pictures recorded in the flight, read by ffmpeg."""

import contextlib
import csv
import io
import json
import math
import pathlib
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import unittest

import klvdata
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from stanag4609.st0903_geo import decode_location
from tstrans import klv
from tstrans.io import parse_file

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402

METRES = 111_320.0
VMTI = bytes.fromhex("060e2b34020b01010e01030306000000")


def can_begin(datagram):
    """Whether a packet of it begins a picture that can be begun with (random access indicator)."""
    packets = [datagram[at : at + 188] for at in range(0, len(datagram), 188)]
    return any(packet[3] & 0x20 and packet[4] and packet[5] & 0x40 for packet in packets)


def received(line, seconds):
    """Datagrams of that many seconds from now on, the first ones those of a picture that can be begun with. A picture begins a
    datagram, with the tables (PID 0)."""
    line.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            line.recv(65_536)
    line.setblocking(True)
    line.settimeout(60)
    datagrams = []
    while not datagrams or not can_begin(datagrams[-1]):
        datagram = line.recv(65_536)
        if int.from_bytes(datagram[1:3], "big") & 0x1FFF == 0:
            datagrams = []
        datagrams.append(datagram)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        datagrams.append(line.recv(65_536))
    return datagrams


class LiveVideo(unittest.TestCase):
    maxDiff = None

    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        at = cls.at = pathlib.Path(folder.name)
        flight = rig.Flight(seconds=40)
        cls.addClassCleanup(flight.close)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
            line.bind(("127.0.0.1", 0))
            there = f'[video]\nsend_to = ["127.0.0.1:{line.getsockname()[1]}"]\nrecord = true\n'
            daemon = rig.Daemon(flight, there)
            try:
                daemon.wait("event=target_tracking", seconds=120)
                cls.datagrams = received(line, 15)
            finally:
                kept = at / "card"
                daemon.stopped.set()
                daemon.process.terminate()
                daemon.process.wait(30)
                # The flight has its date as a name by now.
                (card,) = (daemon.at / "card/FLIGHTS").iterdir()
                shutil.copytree(card, kept)
                daemon.stop()
        cls.film = at / "film.ts"
        cls.film.write_bytes(b"".join(cls.datagrams))
        rig.windhover("export", kept, "--format", "csv", "--out", at / "csv")
        cls.tables = {path.stem: list(csv.DictReader(io.StringIO(path.read_text()))) for path in (at / "csv").glob("*.csv")}
        packets = [bytes(event.payload) for event in parse_file(str(cls.film)) if "Metadata" in type(event).__name__]
        cls.packets = [packet for packet in packets if not packet.startswith(VMTI)]
        cls.targets = [packet for packet in packets if packet.startswith(VMTI)]
        cls.card = kept
        cls.ahead_ns = [health.utc_minus_host_ns for health in cls.messages("/health") if health.HasField("utc_minus_host_ns")][-1]

    @classmethod
    def messages(cls, topic):
        """Those of the flight on the card."""
        for segment in sorted(cls.card.glob("*.mcap")):
            with open(segment, "rb") as file:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                yield from (message for _, _, _, message in reader.iter_decoded_messages(topics=[topic]))

    def test_datagrams_hold_whole_packets(self):
        for datagram in self.datagrams:
            self.assertLessEqual(len(datagram), 7 * 188)
            self.assertEqual(set(datagram[::188]), {0x47})

    def test_the_verifier_finds_no_fault(self):
        verify = pathlib.Path(sys.executable).with_name("stanag4609-verify")
        words = [verify, "--no-require-security", "--format", "json", self.film]
        report = json.loads(subprocess.run(words, capture_output=True, text=True).stdout)
        # A busy machine leaves out frames: gaps in time are the machine's, not the stream's. Times are the host's until the
        # receiver reports the date: they step once, and ST 0604's status reports it.
        stamps = [klv.decode_uas_datalink(packet).timestamp_us for packet in self.packets]
        self.assertLessEqual(sum(b <= a for a, b in zip(stamps, stamps[1:])), 1)
        busy = lambda f: f["code"] == "st1402.pts.interval" or "monotonic" in f["message"]  # noqa: E731
        findings = [f for f in report["findings"] if f["status"] in ("error", "fail") and not busy(f)]
        self.assertEqual(findings, [])
        self.assertGreater(report["metadata"]["st0601_packets"], 20)

    def test_packets_tell_what_the_flight_tells(self):
        estimates = {int(row["time_ns"]): row for row in self.tables["estimates"] if row["north_m"]}
        own = {int(row["time_ns"]): row for row in self.tables["ownship"] if row["frame"]}
        checked = 0
        for sensor, vmti in zip(self.packets, self.targets):
            (parsed,) = list(klvdata.StreamParser(sensor))
            self.assertEqual(parsed.MetadataList()[10][3], "windhover")
            said = klv.decode_uas_datalink(sensor)
            found = klv.decode_vmti(vmti[17:] if vmti[16] < 128 else vmti[17 + (vmti[16] & 0x7F):])
            # Frames are 100 ms apart; what the receiver's clock is ahead of the host's is fitted anew each second.
            t = min(own, key=lambda t: abs(said.timestamp_us - (t + self.ahead_ns) // 1000))
            if abs(said.timestamp_us - (t + self.ahead_ns) // 1000) > 20_000 or t not in estimates or not found.targets:
                continue
            checked += 1
            row, platform = estimates[t], {name: float(value) for name, value in own[t].items()}
            w, x, y, z = (platform[name] for name in ("qw", "qx", "qy", "qz"))
            heading = math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
            self.assertAlmostEqual(math.remainder(said.platform_heading_deg - heading, 360), 0, delta=0.003)
            # The middle of what the camera sees is some metres around the vehicle; the target's place is the flight's.
            place = decode_location(found.targets[0].target_location)
            self.assertLess(abs(place.latitude - float(row["lat_deg"])) * METRES, 0.03)
            self.assertLess(abs(place.longitude - float(row["lon_deg"])) * METRES, 0.03)
        self.assertGreater(checked, 5)

    def test_ffmpeg_decodes_what_was_sent_and_what_was_recorded(self):
        if not shutil.which("ffprobe"):
            rig.leave_out(self, "ffmpeg is not installed")
        recorded = self.at / "recorded.h264"
        count = 0
        with open(recorded, "wb") as out:
            for video in self.messages("/camera/video"):
                self.assertEqual((video.format, video.frame_id), ("h264", "camera"))
                out.write(video.data)
                count += 1
        for path, expected in ((recorded, count), (self.film, len(self.packets))):
            words = ["ffprobe", "-v", "error", "-count_frames", "-select_streams", "v", "-show_streams", "-of", "json", path]
            (video,) = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)["streams"]
            self.assertEqual((video["codec_name"], video["width"], video["height"]), ("h264", 640, 512))
            # The last picture of a stream that was cut off may be lost.
            self.assertAlmostEqual(int(video["nb_read_frames"]), expected, delta=1)


if __name__ == "__main__":
    unittest.main()
