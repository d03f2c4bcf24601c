"""A flight opened by readers that know nothing of windhover: Python's mcap and Foxglove's schemas."""

import csv
import pathlib
import tempfile
import unittest

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from rig import windhover as run


class Flight(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.at = pathlib.Path(cls.folder.name)
        run("simulate", cls.at / "capture.mcap", "--scenario", "follow", "--duration", 8, "--scale", 0.5)
        run("replay", cls.at / "capture.mcap", "--out", cls.at / "flight.mcap")
        run("export", cls.at / "flight.mcap", "--format", "csv", "--out", cls.at / "csv")

    @classmethod
    def tearDownClass(cls):
        cls.folder.cleanup()

    def messages(self):
        with open(self.at / "flight.mcap", "rb") as file:
            yield from make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()

    def test_every_topic_has_its_schema(self):
        schemas = {channel.topic: schema.name for schema, channel, _, _ in self.messages()}
        wanted = {
            "/gps/serial": "windhover.SerialBytes",
            "/compass/serial": "windhover.SerialBytes",
            "/camera/image": "foxglove.CompressedImage",
            "/gps/fix": "foxglove.LocationFix",
            "/target/ugv/location": "foxglove.LocationFix",
            "/target/ugv/state": "windhover.TargetState",
            "/tf": "foxglove.FrameTransform",
            "/camera/calibration": "foxglove.CameraCalibration",
            "/camera/annotations": "foxglove.ImageAnnotations",
            "/log": "foxglove.Log",
            "/health": "windhover.Health",
        }
        for topic, schema in wanted.items():
            self.assertEqual(schemas.get(topic), schema, topic)

    def test_published_schemas_read_our_bytes(self):
        with open(self.at / "flight.mcap", "rb") as file:
            locations = images = 0
            for _, channel, message in make_reader(file).iter_messages():
                if channel.topic == "/target/ugv/location":
                    fix = LocationFix.FromString(message.data)
                    self.assertTrue(-90 < fix.latitude < 90 and fix.latitude != 0)
                    self.assertEqual(len(fix.position_covariance), 9)
                    locations += 1
                elif channel.topic == "/camera/image":
                    image = CompressedImage.FromString(message.data)
                    self.assertEqual(image.format, "jpeg")
                    self.assertEqual(image.data[:2], b"\xff\xd8")
                    images += 1
            self.assertGreater(locations, 50)
            self.assertGreater(images, 100)

    def test_tables_have_a_row_a_frame(self):
        with open(self.at / "csv/estimates.csv") as file:
            rows = list(csv.DictReader(file))
        frames = sum(channel.topic == "/camera/image" for _, channel, _, _ in self.messages())
        self.assertEqual([int(row["frame"]) for row in rows], list(range(frames)))
        last = rows[-1]
        self.assertEqual(last["status"], "tracking")
        self.assertGreaterEqual(len(last["lat_deg"].split(".")[1]), 9)
        with open(self.at / "csv/datum.csv") as file:
            self.assertEqual(len(list(csv.DictReader(file))), 1)

    def test_the_transforms_form_one_tree(self):
        edges = {(tf.child_frame_id, tf.parent_frame_id) for _, c, _, tf in self.messages() if c.topic == "/tf"}
        self.assertEqual(edges, {("camera", "body"), ("body", "ned"), ("target/ugv", "ned")})


if __name__ == "__main__":
    unittest.main()
