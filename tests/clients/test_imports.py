"""Logs and bags written by other people's programs (or read by them, where they only read), imported, and the capture's
MAVLink read by pymavlink: the same figures in, the same figures out."""

import csv
import io
import math
import pathlib
import re
import struct
import subprocess
import sys
import tempfile
import unittest

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from pymavlink import DFReader
from pymavlink.dialects.v20 import common
from pyulog import ULog
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402

UTC = 1_795_000_000  # seconds since 1970 of the first sample
JPEG = bytes.fromhex(
    "ffd8ffe000104a46494600010100000100010000ffdb004300" + "03" * 64 + "ffc0000b080008000801011100ffc4001f"
    "0000010501010101010100000000000000000102030405060708090a0bffc400b5100002010303020403050504040000017d"
    + "00" * 162 + "ffda0008010100003f00d2cf20ffd9"
) + bytes(20_000)  # more than a page of SQLite


def states(seconds=2, rate=10):
    """Time, place, attitude, rates and forces of a helicopter that climbs and turns."""
    for k in range(seconds * rate):
        t = k / rate
        yaw, pitch, roll = 0.5 + 0.2 * t, 0.05, -0.1
        yield t, (47.1 + 1e-5 * t, 8.2 - 2e-5 * t, 500 + t), (yaw, pitch, roll), (0.01, -0.02, 0.2), (0.5, -0.9, -9.7)


def quaternion(yaw, pitch, roll):
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a / 2), math.sin(a / 2)) for a in (yaw, pitch, roll))
    return (cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy)


def multiply(a, b):
    (w, x, y, z), (s, i, j, k) = a, b
    return (w * s - x * i - y * j - z * k, w * i + x * s + y * k - z * j, w * j - x * k + y * s + z * i, w * k + x * j - y * i + z * s)


class Imports(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.at = pathlib.Path(folder.name)

    def capture(self, *words):
        out = self.at / "capture.mcap"
        rig.windhover("import", *words, "--out", out)
        packets, frames, made_of = [], [], ""
        parser = common.MAVLink(io.BytesIO())
        with open(out, "rb") as file:
            for _, channel, message, decoded in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
                if channel.topic == "/camera/image":
                    frames.append((message.log_time, decoded))
                elif channel.topic == "/autopilot/mavlink":
                    made_of = channel.metadata.get("windhover.made_of", "")
                    packets += [(message.log_time, packet) for packet in parser.parse_buffer(decoded.data) or []]
        return packets, frames, made_of

    def of(self, packets, name):
        return [(t, packet) for t, packet in packets if packet.get_type() == name]

    def check(self, packets, seconds=2, utc=True, sats=14):
        """Figures as `states` has them."""
        truth = list(states(seconds))
        fixes, attitudes, inertial = (self.of(packets, n) for n in ("GPS_RAW_INT", "ATTITUDE_QUATERNION", "HIGHRES_IMU"))
        self.assertEqual({len(fixes), len(attitudes), len(inertial)}, {len(truth)})
        self.assertGreaterEqual(len(self.of(packets, "HEARTBEAT")), seconds)
        began = UTC * 10**9 if utc else packets[0][0]
        for (at, place, angles, rates, forces), (t, fix), (_, attitude), (_, imu) in zip(truth, fixes, attitudes, inertial):
            self.assertAlmostEqual((t - began) / 1e9, at, delta=2e-6)
            np.testing.assert_allclose([fix.lat * 1e-7, fix.lon * 1e-7], place[:2], atol=1e-7)
            self.assertAlmostEqual(fix.alt * 1e-3, place[2], delta=0.011)
            self.assertEqual((fix.fix_type, fix.satellites_visible), (3, sats))
            converted = [attitude.q1, attitude.q2, attitude.q3, attitude.q4]
            self.assertAlmostEqual(abs(np.dot(converted, quaternion(*angles))), 1, delta=1e-6)
            np.testing.assert_allclose([imu.xgyro, imu.ygyro, imu.zgyro], rates, atol=1e-6)
            np.testing.assert_allclose([imu.xacc, imu.yacc, imu.zacc], forces, atol=1e-6)
        if utc:
            (t, time), *_ = self.of(packets, "SYSTEM_TIME")
            self.assertAlmostEqual(time.time_unix_usec, t / 1e3, delta=1000)

    def refused(self, *words):
        run = subprocess.run([rig.BINARY, "import", *map(str, words), "--out", self.at / "no.mcap"], capture_output=True, text=True)
        self.assertEqual(run.returncode, 1, run.stderr)
        self.assertEqual(len(run.stderr.splitlines()), 1, run.stderr)
        self.assertFalse((self.at / "no.mcap").exists())
        return run.stderr

    def ulog(self, path, new_names):
        """A ULog of a flight whose clock began a hundred seconds before."""
        fix = (
            "double latitude_deg;double longitude_deg;double altitude_msl_m;double altitude_ellipsoid_m;" if new_names
            else "int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
        )
        formats = [
            "nested:float[2] x;uint8_t _padding0;",
            "vehicle_attitude:uint64_t timestamp;nested[2] n;float[4] q;",
            "sensor_combined:uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
            f"sensor_gps:uint64_t timestamp;uint64_t time_utc_usec;{fix}float eph;float epv;float vel_n_m_s;float vel_e_m_s;"
            "uint8_t fix_type;uint8_t satellites_used;",
            "other:uint64_t timestamp;char[8] word;",
        ]
        record = lambda kind, body: struct.pack("<HB", len(body), ord(kind)) + body  # noqa: E731
        log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 10**8) + record("B", bytes(40))
        log += b"".join(record("F", text.encode()) for text in formats)
        for number, name in enumerate(("vehicle_attitude", "sensor_combined", "sensor_gps", "other")):
            log += record("A", struct.pack("<BH", 0, number) + name.encode())
        for t, (lat, lon, alt), angles, rates, forces in states():
            usec = 10**8 + round(t * 1e6)
            data = lambda number, body: record("D", struct.pack("<HQ", number, usec) + body)  # noqa: B023, E731
            place = struct.pack("<4d", lat, lon, alt, alt + 47) if new_names else struct.pack(
                "<4i", round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), round((alt + 47) * 1e3))
            log += data(0, struct.pack("<2fB2fB4f", 0, 0, 0, 0, 0, 0, *quaternion(*angles)))
            log += data(1, struct.pack("<6f", *rates, *forces)) + data(3, b"whatever")
            log += data(2, struct.pack("<Q", UTC * 10**6 + round(t * 1e6)) + place + struct.pack("<4fBB", 0.7, 1.1, 3, -4, 3, 14))
        path.write_bytes(log)

    def test_ulog(self):
        for new_names in (True, False):
            path = self.at / "flight.ulg"
            self.ulog(path, new_names)
            theirs = {data.name: data.data for data in ULog(str(path)).data_list}
            packets, _, made_of = self.capture("--log", path)
            self.check(packets)
            self.assertIn("sensor_gps", made_of)
            fix = self.of(packets, "GPS_RAW_INT")[0][1]
            self.assertEqual((fix.h_acc, fix.v_acc, fix.vel, fix.cog), (700, 1100, 500, 30687))
            self.assertEqual(fix.alt_ellipsoid - fix.alt, 47000)
            converted = [imu.zacc for _, imu in self.of(packets, "HIGHRES_IMU")]
            np.testing.assert_array_equal(np.float32(converted), theirs["sensor_combined"]["accelerometer_m_s2[2]"])
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) * 2 // 3])
        self.assertTrue(len(self.capture("--log", path)[0]) > 30)
        path.write_bytes(whole[:500])
        self.assertIn("has nothing usable", self.refused("--log", path))

    def test_dataflash(self):
        path = self.at / "flight.bin"
        head = lambda kind: struct.pack("<BBB", 0xA3, 0x95, kind)  # noqa: E731
        formats = {
            129: ("ATT", "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", "<QhhhhHH"),
            130: ("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", "<QBffffff"),
            131: ("GPS", "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U", "<QBBIHBhiiiffffB"),
            132: ("GPA", "QBCCCC", "TimeUS,I,VDop,HAcc,VAcc,SAcc", "<QBHHHH"),
        }
        log = head(128) + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
        for kind, (name, letters, labels, layout) in formats.items():
            length = 3 + struct.calcsize(layout)
            log += head(128) + struct.pack("<BB4s16s64s", kind, length, name.encode(), letters.encode(), labels.encode())
        put = lambda kind, *fields: head(kind) + struct.pack(formats[kind][3], *fields)  # noqa: E731
        gps_s = UTC + 18 - 315_964_800
        for t, (lat, lon, alt), (yaw, pitch, roll), rates, forces in states():
            usec = 5 * 10**7 + round(t * 1e6)
            hundredths = [round(math.degrees(a) * 100) for a in (roll, pitch, yaw)]
            log += put(129, usec, 0, hundredths[0], 0, hundredths[1], 0, hundredths[2])
            log += put(130, usec, 0, *rates, *forces) + put(130, usec, 1, 9, 9, 9, 9, 9, 9)
            log += put(132, usec, 0, 100, 80, 120, 30)
            log += put(131, usec, 0, 3, gps_s % 604800 * 1000 + round(t * 1000), gps_s // 604800, 14, 90, round(lat * 1e7),
                       round(lon * 1e7), round(alt * 100), 5.0, 306.87, 0.0, 0.0, 1)
        path.write_bytes(log)
        reader = DFReader.DFReader_binary(str(path))
        theirs = []
        while (message := reader.recv_match(type=["GPS"])) is not None:
            theirs.append((message._timestamp, message.Lat, message.Lng))
        packets, _, made_of = self.capture("--log", path)
        fixes = self.of(packets, "GPS_RAW_INT")
        np.testing.assert_allclose([(t / 1e9, f.lat * 1e-7, f.lon * 1e-7) for t, f in fixes], theirs, atol=2e-3, rtol=0)
        np.testing.assert_allclose([f.lat * 1e-7 for _, f in fixes], [lat for _, lat, _ in theirs], atol=1e-8, rtol=0)
        truth = list(states())
        for (_, q), (_, _, angles, _, _) in zip(self.of(packets, "ATTITUDE_QUATERNION"), truth):
            # Hundredths of a degree.
            self.assertGreater(abs(np.dot([q.q1, q.q2, q.q3, q.q4], quaternion(*angles))), math.cos(math.radians(0.02)))
        self.assertEqual(len(self.of(packets, "HIGHRES_IMU")), len(truth), "the first IMU alone")
        self.assertEqual((fixes[0][1].h_acc, fixes[0][1].v_acc), (800, 1200))
        self.assertIn("ATT, GPS, IMU", made_of)
        # Bytes that are none of it cost themselves only.
        path.write_bytes(log[:2000] + b"\xa3\x95\xff rubbish \xa3" + log[2000:])
        self.assertGreaterEqual(len(self.capture("--log", path)[0]), len(packets) - 2)

    def test_tlog(self):
        path = self.at / "flight.tlog"
        sender = common.MAVLink(None, srcSystem=7, srcComponent=1)
        kept = b""
        with open(path, "wb") as file:
            for t, (lat, lon, alt), _, _, _ in states():
                usec = round((UTC + t) * 1e6)
                for message in (
                    common.MAVLink_heartbeat_message(4, 3, 0, 0, 4, 3),
                    common.MAVLink_gps_raw_int_message(usec, 3, round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), 90, 90, 500, 0, 14),
                ):
                    packed = message.pack(sender)
                    kept += packed
                    file.write(struct.pack(">Q", usec) + packed)
        packets, _, made_of = self.capture("--log", path)
        self.assertEqual(b"".join(bytes(packet.get_msgbuf()) for _, packet in packets), kept)
        self.assertEqual(packets[0][0], UTC * 10**9)
        self.assertEqual(made_of, "", "the original bytes")

    def bag_messages(self, store):
        """Topic, type, time, message: forward, left, up in east, north, up."""
        types = store.types
        time = types["builtin_interfaces/msg/Time"]
        none = np.array([-1.0] + [0.0] * 8)
        half = math.sqrt(0.5)
        for k, (t, place, angles, rates, forces) in enumerate(states()):
            ns = UTC * 10**9 + round(t * 1e9)
            stamp = time(sec=ns // 10**9, nanosec=ns % 10**9)
            fields = {"stamp": stamp, "frame_id": "base_link"}
            if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__:
                fields["seq"] = k
            header = types["std_msgs/msg/Header"](**fields)
            status = types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
            variances = np.diag([0.32, 0.32, 1.44]).flatten()
            yield "/fix", "sensor_msgs/msg/NavSatFix", ns, types["sensor_msgs/msg/NavSatFix"](
                header=header, status=status, latitude=place[0], longitude=place[1], altitude=float(place[2]),
                position_covariance=variances, position_covariance_type=2)
            # enu_from_ned · ned_from_frd · frd_from_flu
            w, x, y, z = multiply(multiply((0, half, half, 0), quaternion(*angles)), (0, 1, 0, 0))
            vector, turned = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
            flu = lambda v: vector(x=v[0], y=-v[1], z=-v[2])  # noqa: E731
            yield "/imu/data", "sensor_msgs/msg/Imu", ns, types["sensor_msgs/msg/Imu"](
                header=header, orientation=turned(x=x, y=y, z=z, w=w), orientation_covariance=np.zeros(9),
                angular_velocity=flu(rates), angular_velocity_covariance=np.zeros(9),
                linear_acceleration=flu(forces), linear_acceleration_covariance=np.zeros(9))
            yield "/imu/data_raw", "sensor_msgs/msg/Imu", ns, types["sensor_msgs/msg/Imu"](
                header=header, orientation=turned(x=0.0, y=0.0, z=0.0, w=0.0), orientation_covariance=none,
                angular_velocity=flu(rates), angular_velocity_covariance=np.zeros(9),
                linear_acceleration=flu(forces), linear_acceleration_covariance=np.zeros(9))
            yield "/camera/image_raw", "sensor_msgs/msg/Image", ns, types["sensor_msgs/msg/Image"](
                header=header, height=4, width=6, encoding="mono8", is_bigendian=0, step=6,
                data=np.arange(24, dtype=np.uint8) + k)
            yield "/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage", ns, types["sensor_msgs/msg/CompressedImage"](
                header=header, format="jpeg", data=np.frombuffer(JPEG, np.uint8))

    def check_bag(self, path):
        packets, frames, made_of = self.capture("--bag", path)
        self.check(packets, sats=255)
        self.assertIn("/fix, /imu/data", made_of)
        fix = self.of(packets, "GPS_RAW_INT")[0][1]
        self.assertEqual((fix.h_acc, fix.v_acc, fix.vel), (800, 1200, 65535))
        self.assertEqual([t for t, _ in frames], [UTC * 10**9 + round(t * 1e9) for t, *_ in states()])
        for k, (_, image) in enumerate(frames):
            self.assertEqual((image.encoding, image.width, image.height, image.step), ("mono8", 6, 4, 6))
            self.assertEqual(image.data, bytes(range(k, 24 + k)))
        _, frames, _ = self.capture("--bag", path, "--topic", "/camera/image_raw/compressed")
        self.assertEqual({image.data for _, image in frames}, {JPEG})

    def test_ros1_bags(self):
        store = get_typestore(Stores.ROS1_NOETIC)
        for compression in (None, rosbag1.Writer.CompressionFormat.BZ2, rosbag1.Writer.CompressionFormat.LZ4):
            path = self.at / f"{compression and compression.name}.bag"
            writer = rosbag1.Writer(path)
            if compression:
                writer.set_compression(compression)
            with writer:
                connections = {}
                for topic, kind, ns, message in self.bag_messages(store):
                    if topic not in connections:
                        connections[topic] = writer.add_connection(topic, kind, typestore=store)
                    writer.write(connections[topic], ns, store.serialize_ros1(message, kind))
            self.check_bag(path)
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        self.assertIn("cut off", self.refused("--bag", path))

    def test_ros2_bags(self):
        store = get_typestore(Stores.ROS2_JAZZY)
        for plugin in rosbag2.StoragePlugin:
            path = self.at / plugin.name
            with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
                connections = {}
                for topic, kind, ns, message in self.bag_messages(store):
                    if topic not in connections:
                        connections[topic] = writer.add_connection(topic, kind, typestore=store)
                    writer.write(connections[topic], ns, store.serialize_cdr(message, kind))
            self.check_bag(path)
            for file in [*path.glob("*.db3"), *path.glob("*.mcap")]:
                self.check_bag(file)

    def test_a_bag_flies(self):
        # Given: a flight as a bag. When: its fixes, attitude and images are imported, and flown as an autopilot's.
        rig.windhover("simulate", self.at / "sim.mcap", "--scenario", "follow", "--duration", 6, "--scale", 0.5)
        rig.windhover("replay", self.at / "sim.mcap", "--out", self.at / "flight.mcap")
        rig.windhover("export", self.at / "flight.mcap", "--format", "rosbag2", "--out", self.at / "bag")
        topics = [word for name in ("/gps/fix", "/ownship/imu", "/camera/image/compressed") for word in ("--topic", name)]
        rig.windhover("import", "--bag", self.at / "bag", *topics, "--out", self.at / "capture.mcap")
        with open(self.at / "sim.mcap", "rb") as file:
            config = next(make_reader(file).iter_attachments()).data.decode()
        config = re.sub(r"^\[(gps|compass)\]\n(?:(?!\[\w).*\n)*", "", config, flags=re.M)
        # Heights in a NavSatFix are above the ellipsoid, which lies 27 m below the sea here.
        config = re.sub("elevation_msl_m = 33.0", "elevation_msl_m = 6.0", config)
        config += '\n[autopilot]\nlisten = "udp://127.0.0.1:14550"\nuse = ["attitude", "gps"]\n'
        (self.at / "autopilot.toml").write_text(config)
        rig.windhover("replay", self.at / "capture.mcap", "--config", self.at / "autopilot.toml", "--out", self.at / "again.mcap")
        rig.windhover("export", self.at / "again.mcap", "--format", "csv", "--out", self.at / "csv")
        # Then: the vehicle is where the truth has it, as far as a receiver tells.
        read = lambda path: {int(row["frame"]): row for row in csv.DictReader(io.StringIO(path.read_text()))}  # noqa: E731
        estimates, truth = read(self.at / "csv/estimates.csv"), read(self.at / "sim.truth.csv")
        tracked = [row for row in estimates.values() if row["status"] == "tracking"]
        self.assertGreater(len(tracked), 60)
        for row in tracked[30:]:
            true = truth[int(row["frame"])]
            apart = [(float(row[n]) - float(true[n])) * 111_000 for n in ("lat_deg", "lon_deg")]
            self.assertLess(math.hypot(*apart), 4.0)
            turned = math.remainder(float(row["heading_rad"]) - float(true["heading_rad"]), 2 * math.pi)
            self.assertLess(abs(turned), 0.05)

    def test_damage_costs_what_it_hits(self):
        store, made = get_typestore(Stores.ROS1_NOETIC), {}
        self.ulog(self.at / "flight.ulg", True)
        with rosbag1.Writer(self.at / "flight.bag") as writer:
            connections = {}
            for topic, kind, ns, message in self.bag_messages(store):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], ns, store.serialize_ros1(message, kind))
        store = get_typestore(Stores.ROS2_JAZZY)
        with rosbag2.Writer(self.at / "bag", version=9) as writer:
            connection = writer.add_connection("/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage", typestore=store)
            for topic, kind, ns, message in self.bag_messages(store):
                if topic == connection.topic:
                    writer.write(connection, ns, store.serialize_cdr(message, kind))
        made = {"--log": [self.at / "flight.ulg"], "--bag": [self.at / "flight.bag", self.at / "bag/bag.db3"]}
        random = np.random.default_rng(7)
        for option, path in ((option, path) for option, paths in made.items() for path in paths):
            whole = np.frombuffer(path.read_bytes(), np.uint8)
            for trial in range(15):
                damaged = whole.copy()
                # Most at the begin, where everything is defined.
                places = (random.random(20) ** 3 * len(whole)).astype(int)
                damaged[places] = random.integers(0, 256, 20)
                (self.at / "damaged").write_bytes(damaged.tobytes())
                words = [rig.BINARY, "import", option, self.at / "damaged", "--out", self.at / "out.mcap"]
                run = subprocess.run(words, capture_output=True, text=True, timeout=20)
                self.assertIn(run.returncode, (0, 1, 2), f"{path.name}, trial {trial}: {run.stderr}")
                self.assertNotIn("panicked", run.stderr)

    def test_subtitles_and_what_is_none(self):
        cues = []
        for k, (t, (lat, lon, alt), *_) in enumerate(states()):
            ms = round(t * 1000)
            cues.append(f"{k + 1}\n00:00:{ms // 1000:02},{ms % 1000:03} --> 00:00:59,000\n<font size=\"28\">FrameCnt: {k}\n"
                        f"2026-11-18 11:06:40.{ms % 1000:03}\n[latitude: {lat:.6f}] [longitude: {lon:.6f}] "
                        f"[rel_alt: 1.0 abs_alt: {alt:.3f}] </font>\n")
        path = self.at / "DJI_0001.SRT"
        path.write_text("\n".join(cues))
        packets, _, _ = self.capture("--log", path)
        fixes = self.of(packets, "GPS_RAW_INT")
        self.assertEqual(len(fixes), len(cues))
        for (at, (lat, lon, alt), *_), (t, fix) in zip(states(), fixes):
            self.assertAlmostEqual((t - UTC * 10**9) / 1e9, at, delta=1e-3)
            np.testing.assert_allclose([fix.lat * 1e-7, fix.lon * 1e-7, fix.alt * 1e-3], [lat, lon, alt], atol=1e-6)
        path.write_text("nothing of the kind\n")
        self.assertIn("is none of the supported logs", self.refused("--log", path))
        self.assertIn("is not a bag", self.refused("--bag", path))
        (self.at / "empty").mkdir()
        self.assertIn("has no .mcap and no .db3", self.refused("--bag", self.at / "empty"))


if __name__ == "__main__":
    unittest.main()
