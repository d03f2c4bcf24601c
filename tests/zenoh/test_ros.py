"""A station in the graph of ROS 2, met by `zenoh-ros2-sdk`, which knows nothing of windhover: its list of topics, its
subscribers, its decoder of attachments. Types and hashes come from `rosbags`. Figures are held against what the station
stored.

`make test-zenoh` runs it with a windhover built with the feature `zenoh`.
"""

import pathlib
import socket
import sys
import tempfile
import time
import unittest

import numpy as np
import xxhash
import zenoh
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.discovery import get_topic_info, get_topic_names_and_types
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.session import ZenohSession
from zenoh_ros2_sdk.subscriber import ROS2Subscriber

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402

DOMAIN = 7
JAZZY = get_typestore(Stores.ROS2_JAZZY)
TYPES = {
    "/alpha/target/ugv/odometry": "nav_msgs/msg/Odometry",
    "/alpha/target/ugv/fix": "sensor_msgs/msg/NavSatFix",
    "/alpha/ownship/odometry": "nav_msgs/msg/Odometry",
    "/alpha/ownship/fix": "sensor_msgs/msg/NavSatFix",
    "/alpha/ownship/imu": "sensor_msgs/msg/Imu",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/rosout": "rcl_interfaces/msg/Log",
}


def stamp(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def listening(pid):
    """Local addresses (in the kernel's hexadecimal) at which a process listens over TCP."""
    inodes = set()
    for link in pathlib.Path(f"/proc/{pid}/fd").iterdir():
        try:
            name = str(link.readlink())
        except OSError:
            continue
        if name.startswith("socket:["):
            inodes.add(name[8:-1])
    rows = [
        row.split()
        for table in ("tcp", "tcp6")
        for row in pathlib.Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    ]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and row[9] in inodes}


class Graph(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.at = pathlib.Path(folder.name)
        flight = rig.Flight()
        self.addCleanup(flight.close)
        reach = f"127.0.0.1:{rig.free_port()}"
        daemon = rig.Daemon(flight, rig.link_tables(self.at / "keys", reach))
        self.addCleanup(daemon.stop)
        self.port = rig.free_port(socket.SOCK_STREAM)
        file = self.at / "zenoh.json5"
        file.write_text(
            f'{{ mode: "router", listen: {{ endpoints: ["tcp/127.0.0.1:{self.port}"] }}, '
            "scouting: { multicast: { enabled: false } } }"
        )
        words = ("--no-web", "--zenoh", str(file), "--ros", str(DOMAIN))
        self.station = rig.station(self.at / "keys", reach, self.at / "ground", *words)
        self.addCleanup(self.station.wait)
        self.addCleanup(self.station.terminate)
        rig.until(lambda: rig.listens(self.port), 30, lambda: "the station does not listen")
        self.where = {"domain_id": DOMAIN, "router_ip": "127.0.0.1", "router_port": self.port}
        self.sdk = ZenohSession.get_instance("127.0.0.1", self.port)
        self.addCleanup(self.sdk.close)
        # The reader's own definitions, those of Jazzy.
        self.sdk.store = JAZZY
        self.sdk._registered_types = {name: name for name in JAZZY.types}

    def subscribe(self, topic, qos=None):
        received = []
        kind = TYPES[topic]
        subscriber = ROS2Subscriber(
            topic, kind, received.append, type_hash=JAZZY.hash_rihs01(kind), qos=qos, **self.where
        )
        self.addCleanup(subscriber.close)
        return received

    def test_topics_types_and_nodes_are_listed(self):
        topics = lambda: dict(get_topic_names_and_types(timeout=2.0, **self.where))  # noqa: E731
        rig.until(lambda: set(TYPES) <= set(topics()), 90, lambda: f"listed: {topics()}")
        found = topics()
        for topic, kind in TYPES.items():
            self.assertEqual(found[topic], [kind], topic)
            info = get_topic_info(topic, timeout=2.0, verbose=True, **self.where)
            self.assertEqual((info.publisher_count, info.subscriber_count), (1, 0), topic)
            (publisher,) = info.publishers
            self.assertEqual((publisher.node_namespace, publisher.node_name), ("/alpha", "windhover"))
            self.assertEqual(publisher.type_hash, JAZZY.hash_rihs01(kind), topic)
            kept = QosProfile.decode(publisher.qos).durability == QosDurability.TRANSIENT_LOCAL
            self.assertEqual(kept, topic == "/tf_static", topic)
        # And: another domain sees nothing, and nothing listens beyond loopback.
        other = get_topic_names_and_types(timeout=2.0, **{**self.where, "domain_id": 0})
        self.assertEqual(other, [])
        self.assertEqual(listening(self.station.pid), {"0100007F"})

    def test_messages_are_the_flights_and_count_themselves(self):
        targets = self.subscribe("/alpha/target/ugv/odometry")
        own = self.subscribe("/alpha/ownship/odometry")
        diagnostics = self.subscribe("/diagnostics")
        kind = "nav_msgs/msg/Odometry"
        key = f"{DOMAIN}/alpha/target/ugv/odometry/nav_msgs::msg::dds_::Odometry_/{JAZZY.hash_rihs01(kind)}"
        attached = []
        self.sdk.session.declare_subscriber(
            key, lambda s: attached.append((time.time_ns(), Attachment.from_bytes(s.attachment.to_bytes())))
        )
        enough = lambda: len(targets) > 150 and len(own) > 50 and len(diagnostics) > 2  # noqa: E731
        rig.until(enough, 120, lambda: f"{len(targets)} of the target, {len(own)}, {len(diagnostics)}")
        # A late subscriber gets the tree's constant part, and what is published late finds its early subscriber.
        latched = self.subscribe("/tf_static", QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1))
        rig.until(lambda: latched, 10, lambda: "nothing for the late subscriber")
        (earth,) = latched[0].transforms
        self.assertEqual((earth.header.frame_id, earth.child_frame_id), ("earth", "alpha/map"))
        radius = np.linalg.norm([earth.transform.translation.x, earth.transform.translation.y, earth.transform.translation.z])
        self.assertTrue(6.35e6 < radius < 6.39e6, radius)
        # Numbers without a gap from one publisher, whose identity is that of its token.
        numbers = [a.sequence_id for _, a in attached]
        self.assertEqual(numbers, list(range(numbers[0], numbers[0] + len(numbers))))
        tokens = [
            str(reply.ok.key_expr)
            for reply in self.sdk.liveliness.get(f"@ros2_lv/{DOMAIN}/*/*/*/MP/**", timeout=5.0)
            if "/%alpha%target%ugv%odometry/" in str(reply.ok.key_expr)
        ]
        self.assertEqual(len(tokens), 1, tokens)
        gid = xxhash.xxh3_128(tokens[0].encode()).intdigest().to_bytes(16, "little")
        self.assertEqual({a.gid for _, a in attached}, {gid})
        lateness = [(now - a.timestamp_ns) / 1e9 for now, a in attached]
        self.assertTrue(-0.05 < min(lateness) and np.median(lateness) < 0.5, (min(lateness), np.median(lateness)))
        # The same figures as in what the station stored.
        self.station.terminate()
        self.station.wait()
        stored = {}
        for path in sorted((self.at / "ground").glob("*/*/*.mcap")):
            with open(path, "rb") as file:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                for _, channel, _, state in reader.iter_decoded_messages():
                    if channel.topic in ("/target/ugv/state", "/target/ugv/coasting"):
                        stored[state.timestamp.ToNanoseconds()] = state
        compared = 0
        for message in targets:
            self.assertEqual((message.header.frame_id, message.child_frame_id), ("alpha/map", "alpha/ugv/base_link"))
            state = stored.get(stamp(message.header))
            if state is None:
                continue
            compared += 1
            at = message.pose.pose.position
            self.assertEqual((at.x, at.y), (state.east_m, state.north_m))
            self.assertEqual(message.twist.twist.linear.x, state.speed_mps)
            self.assertEqual(message.pose.covariance[0], state.covariance[5])
            self.assertEqual(message.twist.covariance[35], state.covariance[14])
        self.assertGreater(compared, 0.9 * len(targets), f"{compared} of {len(targets)} found in the files")
        self.assertEqual({m.header.frame_id for m in own}, {"alpha/map"})
        self.assertIn("alpha/windhover: gps", {s.name for m in diagnostics for s in m.status})


if __name__ == "__main__":
    unittest.main()
