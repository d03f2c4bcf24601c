"""A bag of `export --format rosbag2` opened by readers of ROS 2's bags that know nothing of windhover: `rosbags` and
`mcap-ros2-support`. Figures are held against the flight itself and against its CSV."""

import csv
import io
import math
import pathlib
import sys
import tempfile
import unittest

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_ros2.reader import read_ros2_messages
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402

# Our axes in ROS's: east, north, up of north, east, down; forward, left, up of forward, right, down.
ENU_FROM_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLU_FROM_FRD = np.diag([1, -1, -1])


def rotation(q):
    """Matrix of a quaternion (w, x, y, z)."""
    w, x, y, z = np.array(q) / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])


def symmetric(upper, n):
    matrix = np.zeros((n, n))
    matrix[np.triu_indices(n)] = upper
    return matrix + np.triu(matrix, 1).T


def stamp(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


class Rosbag2(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        at = pathlib.Path(folder.name)
        rig.windhover("simulate", at / "capture.mcap", "--scenario", "follow", "--duration", 8, "--scale", 0.5)
        rig.windhover("replay", at / "capture.mcap", "--out", at / "flight.mcap")
        rig.windhover("export", at / "flight.mcap", "--format", "csv", "--out", at / "csv")
        rig.windhover("export", at / "flight.mcap", "--format", "rosbag2", "--out", at / "bag")
        cls.bag = at / "bag"
        cls.tables = {path.stem: list(csv.DictReader(io.StringIO(path.read_text()))) for path in (at / "csv").glob("*.csv")}
        with open(at / "flight.mcap", "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            cls.ours = {}
            for _, channel, message, decoded in reader.iter_decoded_messages():
                cls.ours.setdefault(channel.topic, []).append(decoded)
        store = get_typestore(Stores.ROS2_JAZZY)
        cls.messages, cls.types = {}, {}
        with Reader(cls.bag) as reader:
            for connection in reader.connections:
                if connection.msgtype not in store.fielddefs:
                    from rosbags.typesys import get_types_from_msg

                    store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
                cls.types[connection.topic] = connection
            for connection, _, data in reader.messages():
                cls.messages.setdefault(connection.topic, []).append(store.deserialize_cdr(data, connection.msgtype))
        cls.store = store

    def test_the_types_are_the_distributions(self):
        wanted = {
            "/ownship/odometry": "nav_msgs/msg/Odometry",
            "/target/ugv/odometry": "nav_msgs/msg/Odometry",
            "/target/ugv/fix": "sensor_msgs/msg/NavSatFix",
            "/gps/fix": "sensor_msgs/msg/NavSatFix",
            "/ownship/imu": "sensor_msgs/msg/Imu",
            "/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
            "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
            "/camera/detections": "apriltag_msgs/msg/AprilTagDetectionArray",
            "/tf": "tf2_msgs/msg/TFMessage",
            "/tf_static": "tf2_msgs/msg/TFMessage",
            "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
            "/rosout": "rcl_interfaces/msg/Log",
        }
        for topic, kind in wanted.items():
            self.assertEqual(self.types[topic].msgtype, kind)
            # The hash that rmw compares is the one this library computes from its own definitions.
            self.assertEqual(self.types[topic].digest, self.store.hash_rihs01(kind), topic)
            self.assertGreater(len(self.messages[topic]), 0, topic)

    def test_the_target_is_where_the_tables_have_it(self):
        rows = {int(row["time_ns"]): row for row in self.tables["estimates"] if row["north_m"]}
        states = {m.timestamp.ToNanoseconds(): m for m in self.ours["/target/ugv/state"] if m.known}
        odometry = self.messages["/target/ugv/odometry"]
        self.assertEqual({stamp(m.header) for m in odometry}, set(rows))
        for message in odometry:
            row, state = rows[stamp(message.header)], states[stamp(message.header)]
            self.assertEqual((message.header.frame_id, message.child_frame_id), ("map", "ugv/base_link"))
            position, q = message.pose.pose.position, message.pose.pose.orientation
            self.assertAlmostEqual(position.x, float(row["east_m"]), delta=1e-3)
            self.assertAlmostEqual(position.y, float(row["north_m"]), delta=1e-3)
            yaw = 2 * math.atan2(q.z, q.w)
            turned = math.remainder(math.pi / 2 - float(row["heading_rad"]) - yaw, 2 * math.pi)
            self.assertAlmostEqual(turned, 0, delta=1e-7)
            self.assertAlmostEqual(message.twist.twist.linear.x, float(row["speed_mps"]), delta=1e-6)
            self.assertAlmostEqual(message.twist.twist.angular.z, -float(row["yaw_rate_radps"]), delta=1e-7)
            p = symmetric(state.covariance, 5)
            pose, twist = message.pose.covariance.reshape(6, 6), message.twist.covariance.reshape(6, 6)
            # To the bit: a covariance of (north, east, heading) in (east, north, yaw).
            change = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
            np.testing.assert_array_equal(pose[np.ix_([0, 1, 5], [0, 1, 5])], change @ p[:3, :3] @ change)
            change = np.diag([1, -1])
            np.testing.assert_array_equal(twist[np.ix_([0, 5], [0, 5])], change @ p[3:, 3:] @ change)

    def test_the_helicopter_is_where_the_tables_have_it(self):
        rows = {int(row["time_ns"]): row for row in self.tables["ownship"]}
        states = {m.timestamp.ToNanoseconds(): m for m in self.ours["/ownship/state"]}
        odometry = self.messages["/ownship/odometry"]
        self.assertEqual({stamp(m.header) for m in odometry}, set(rows))
        for message in odometry:
            row, state = rows[stamp(message.header)], states[stamp(message.header)]
            position, q, v = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
            expected = [float(row[name]) for name in ("east_m", "north_m", "down_m")]
            np.testing.assert_allclose([position.x, position.y, -position.z], expected, atol=1e-3)
            ned_from_body = rotation([float(row[name]) for name in ("qw", "qx", "qy", "qz")])
            expected = ENU_FROM_NED @ ned_from_body @ FLU_FROM_FRD
            np.testing.assert_allclose(rotation([q.w, q.x, q.y, q.z]), expected, atol=1e-8)
            velocity = np.array([float(row[name]) for name in ("vn_mps", "ve_mps", "vd_mps")])
            np.testing.assert_allclose([v.x, v.y, v.z], FLU_FROM_FRD @ ned_from_body.T @ velocity, atol=1e-5)
            p, change = symmetric(state.covariance, 9), np.kron(np.eye(2), ENU_FROM_NED)
            places = [0, 1, 2, 6, 7, 8]
            expected = change @ p[np.ix_(places, places)] @ change.T
            np.testing.assert_array_equal(message.pose.covariance.reshape(6, 6), expected)

    def test_images_have_their_lens_and_what_was_seen(self):
        images, lenses = self.messages["/camera/image/compressed"], self.messages["/camera/camera_info"]
        self.assertEqual([stamp(m.header) for m in images], [stamp(m.header) for m in lenses])
        kept = [bytes(m.data) for m in self.ours["/camera/image"]]
        self.assertEqual([m.data.tobytes() for m in images], kept)
        ours = self.ours["/camera/calibration"][0]
        for lens in lenses:
            self.assertEqual(lens.distortion_model, "plumb_bob")
            np.testing.assert_array_equal(lens.k, ours.K)
            np.testing.assert_array_equal(lens.d, ours.D)
            np.testing.assert_array_equal(lens.p, ours.P)
        seen = [(stamp(m.header), tag) for m in self.messages["/camera/detections"] for tag in m.detections]
        rows = sorted(self.tables["detections"], key=lambda row: (int(row["time_ns"]), int(row["id"])))
        self.assertEqual(len(seen), len(rows))
        for (t, tag), row in zip(sorted(seen, key=lambda pair: (pair[0], pair[1].id)), rows):
            self.assertEqual((t, tag.id, tag.family), (int(row["time_ns"]), int(row["id"]), "tag" + row["family"]))
            corners = [[float(row[f"{axis}{k}"]) for axis in "uv"] for k in (3, 2, 1, 0)]
            np.testing.assert_allclose([[c.x, c.y] for c in tag.corners], corners, atol=1e-4)
            h = tag.homography.reshape(3, 3)
            middle = h @ [0, 0, 1]
            np.testing.assert_allclose(middle[:2] / middle[2], [tag.centre.x, tag.centre.y], atol=0.5)

    def test_transforms_form_one_tree_from_the_earth(self):
        edges = {
            (tf.child_frame_id, tf.header.frame_id): tf.transform
            for topic in ("/tf_static", "/tf") for message in self.messages[topic] for tf in message.transforms
        }
        self.assertEqual(set(edges), {
            ("map", "earth"), ("base_link", "map"), ("ugv/base_link", "map"),
            ("camera_optical_frame", "base_link"), ("gps_link", "base_link"),
        })
        # The target's place on the Earth, by the transforms and by its own latitude and longitude.
        earth, last = edges["map", "earth"], self.messages["/target/ugv/odometry"][-1].pose.pose.position
        fix = self.messages["/target/ugv/fix"][-1]
        q, at = earth.rotation, earth.translation
        by_transform = np.array([at.x, at.y, at.z]) + rotation([q.w, q.x, q.y, q.z]) @ [last.x, last.y, last.z]
        a, f = 6378137.0, 1 / 298.257223563
        lat, lon = math.radians(fix.latitude), math.radians(fix.longitude)
        n = a / math.sqrt(1 - f * (2 - f) * math.sin(lat) ** 2)
        by_fix = [
            (n + fix.altitude) * math.cos(lat) * math.cos(lon), (n + fix.altitude) * math.cos(lat) * math.sin(lon),
            (n * (1 - f) ** 2 + fix.altitude) * math.sin(lat),
        ]
        np.testing.assert_allclose(by_transform, by_fix, atol=1e-3)

    def test_another_reader_reads_the_same(self):
        counts = {}
        for message in read_ros2_messages(str(self.bag / "flight_0.mcap")):
            counts[message.channel.topic] = counts.get(message.channel.topic, 0) + 1
            if message.channel.topic == "/diagnostics":
                names = {status.name for status in message.ros_msg.status}
                self.assertLessEqual({"windhover: gps", "windhover: camera", "windhover: target ugv"}, names)
        self.assertEqual(counts, {topic: len(messages) for topic, messages in self.messages.items()})


if __name__ == "__main__":
    unittest.main()
