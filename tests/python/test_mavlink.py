"""What a running daemon sends as MAVLink, received by pymavlink: the messages, signing, wrong keys."""

import contextlib
import importlib.util
import io
import math
import os
import pathlib
import tempfile
import time
import unittest

os.environ["MAVLINK20"] = "1"

from pymavlink import mavutil  # noqa: E402
from pymavlink.dialects.v20 import common  # noqa: E402
from pymavlink.generator import mavgen  # noqa: E402

import rig  # noqa: E402

KEY = bytes(range(32))
KINDS = {"HEARTBEAT", "GLOBAL_POSITION_INT", "ATTITUDE", "FOLLOW_TARGET"}
MORE = {
    "LANDING_TARGET",
    "UNKNOWN_510",
    "UNKNOWN_511",
    "CAMERA_TRACKING_GEO_STATUS",
    "CAMERA_TRACKING_IMAGE_STATUS",
    "ODOMETRY",
}


def receiver(port, key=None):
    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=255, dialect="common")
    link.robust_parsing = True
    if key is not None:
        # The simulated flight's time, not today's, is what signatures carry.
        link.setup_signing(key, sign_outgoing=True, initial_timestamp=1)
    return link


def target_messages():
    """TARGET_ABSOLUTE and TARGET_RELATIVE, which pymavlink's own dialects do not have: made of their definition."""
    with tempfile.TemporaryDirectory() as folder:
        made = pathlib.Path(folder) / "target_messages.py"
        options = mavgen.Opts(str(made), wire_protocol="2.0", language="Python3", validate=False)
        with contextlib.redirect_stdout(io.StringIO()):
            mavgen.mavgen(options, [str(pathlib.Path(__file__).with_name("target_messages.xml"))])
        spec = importlib.util.spec_from_file_location("target_messages", made)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module


def receive(link, kinds, seconds):
    """The latest message of each kind, until all are there or the time is over; and what was no message."""
    latest, bad, end = {}, 0, time.monotonic() + seconds
    while time.monotonic() < end and not kinds <= set(latest):
        message = link.recv_match(blocking=True, timeout=1)
        if message is None:
            continue
        if message.get_type() == "BAD_DATA":
            bad += 1
        else:
            latest[message.get_type()] = message
    return latest, bad


class Mavlink(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.flight = rig.Flight()

    @classmethod
    def tearDownClass(cls):
        cls.flight.close()

    def fly(self, port, more=""):
        daemon = rig.Daemon(
            self.flight, f'[mavlink]\nenabled = true\nsend_to = ["127.0.0.1:{port}"]\nsystem_id = 77\n{more}'
        )
        self.addCleanup(daemon.stop)
        return daemon

    def test_the_vehicle_appears_under_its_own_system_id(self):
        port = rig.free_port()
        link = receiver(port)
        self.addCleanup(link.close)
        self.fly(port)
        latest, bad = receive(link, KINDS, 90)
        self.assertEqual((set(latest), bad), (KINDS, 0))
        for message in latest.values():
            self.assertEqual((message.get_srcSystem(), message.get_srcComponent()), (77, 1))
            self.assertEqual(message.get_msgbuf()[0], 0xFD, "MAVLink 2")
        self.assertEqual(latest["HEARTBEAT"].type, common.MAV_TYPE_GROUND_ROVER)
        # Position, follow target and attitude tell the same vehicle.
        position, follow, attitude = (latest[k] for k in ("GLOBAL_POSITION_INT", "FOLLOW_TARGET", "ATTITUDE"))
        for a, b in ((position.lat, follow.lat), (position.lon, follow.lon)):
            self.assertLess(abs(a - b), 5_000, "within 50 m, at different times")
        self.assertAlmostEqual(position.alt / 1e3, 33.0, places=2, msg="level ground, above mean sea level")
        self.assertAlmostEqual(follow.alt, 33.0, places=2)
        self.assertTrue(follow.est_capabilities & 0b11 == 0b11, "position and velocity")
        self.assertLess(math.hypot(position.vx, position.vy), 2_000, "no faster than 20 m/s")
        self.assertTrue(-math.pi <= attitude.yaw <= math.pi)

    def test_every_message_in_the_units_of_its_definition(self):
        port = rig.free_port()
        link = receiver(port)
        self.addCleanup(link.close)
        wanted = {name for name in MORE if not name.startswith("UNKNOWN")}
        wanted |= {"FOLLOW_TARGET", "GLOBAL_POSITION_INT", "TARGET_ABSOLUTE", "TARGET_RELATIVE"}
        names = ", ".join(f'"{name}"' for name in sorted(wanted))
        self.fly(port, f"messages = [{names}]\n")
        latest, bad = receive(link, MORE | {"HEARTBEAT", "FOLLOW_TARGET"}, 90)
        self.assertTrue(set(latest) >= MORE and bad == 0, (set(latest), bad))
        parser = target_messages().MAVLink(None)
        absolute, relative = (
            parser.parse_buffer(bytes(latest[name].get_msgbuf()))[0] for name in ("UNKNOWN_510", "UNKNOWN_511")
        )
        self.assertEqual((absolute.get_type(), relative.get_type()), ("TARGET_ABSOLUTE", "TARGET_RELATIVE"))
        landing = latest["LANDING_TARGET"]
        geo, image, odometry = (
            latest[k] for k in ("CAMERA_TRACKING_GEO_STATUS", "CAMERA_TRACKING_IMAGE_STATUS", "ODOMETRY")
        )
        for message in (landing, relative, absolute, geo, image):
            self.assertEqual((message.get_srcSystem(), message.get_srcComponent()), (1, 100))
        self.assertEqual((odometry.get_srcSystem(), odometry.get_srcComponent()), (77, 1))
        # The helicopter is above the vehicle: below it in the body's axes, and in north, east, down.
        self.assertEqual((landing.frame, landing.position_valid), (common.MAV_FRAME_BODY_FRD, 1))
        self.assertTrue(5 < landing.z < 40 and 5 < relative.z < 40, (landing.z, relative.z))
        for angle, across in ((landing.angle_x, landing.y), (-landing.angle_y, landing.x)):
            self.assertAlmostEqual(math.tan(angle), across / landing.z, places=4)
        self.assertAlmostEqual(landing.distance, math.hypot(landing.x, landing.y, landing.z), places=3)
        self.assertEqual(relative.frame, 2, "TARGET_OBS_FRAME_LOCAL_OFFSET_NED")
        self.assertTrue(0 < relative.pos_std[0] < 2 and 0 < relative.yaw_std < 0.5)
        for q in (landing.q, relative.q_target, absolute.q_target, odometry.q):
            self.assertAlmostEqual(sum(x * x for x in q), 1, places=4)
        self.assertEqual(absolute.sensor_capabilities, 31)
        self.assertTrue(abs(absolute.vel[1]) <= abs(absolute.vel[0]) + 0.1, "it drives along its own axis")
        self.assertTrue(0 <= image.rec_top_x <= image.rec_bottom_x <= 1)
        self.assertTrue(0 <= image.rec_top_y <= image.rec_bottom_y <= 1)
        self.assertEqual(geo.tracking_status, common.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE)
        self.assertAlmostEqual(geo.alt, 33.0, places=2)
        frames = (odometry.frame_id, odometry.child_frame_id)
        self.assertEqual(frames, (common.MAV_FRAME_LOCAL_NED, common.MAV_FRAME_BODY_FRD))
        self.assertTrue(odometry.pose_covariance[0] > 0 and odometry.pose_covariance[6] > 0)

    def test_signed_messages_are_believed_with_the_key_only(self):
        with tempfile.TemporaryDirectory() as folder:
            secret = pathlib.Path(folder) / "mavlink.hex"
            secret.write_text(KEY.hex() + "\n")
            secret.chmod(0o600)
            port = rig.free_port()
            link = receiver(port, KEY)
            self.addCleanup(link.close)
            self.fly(port, f'signing_key = "{secret}"\n')
            latest, bad = receive(link, KINDS, 90)
            self.assertEqual((set(latest), bad), (KINDS, 0))
            for message in latest.values():
                self.assertTrue(message.get_signed())
            # The very bytes that one receiver takes, another with a wrong key refuses.
            for key, taken in ((KEY, True), (bytes(32), False)):
                parser = common.MAVLink(None)
                parser.robust_parsing = True
                parser.signing.secret_key = key
                kinds = {m.get_type() for m in parser.parse_buffer(bytes(latest["HEARTBEAT"].get_msgbuf())) or []}
                self.assertEqual(kinds, {"HEARTBEAT"} if taken else {"BAD_DATA"})


if __name__ == "__main__":
    unittest.main()
