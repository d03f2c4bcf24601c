"""What a station tells Foxglove: a client subscribes, and decodes a state with the schema it was given."""

import asyncio
import base64
import json
import pathlib
import socket
import struct
import subprocess
import tempfile
import unittest

import rig
import websockets
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

PROTOCOL = "foxglove.sdk.v1"
TOPIC = "/alpha/target/ugv/state"


def decoder(channel):
    """The message class of a channel, from the descriptor set it was advertised with."""
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    waiting = list(files.file)
    while waiting:
        ready = [f for f in waiting if not set(f.dependency) & {w.name for w in waiting}]
        for file in ready:
            pool.AddSerializedFile(file.SerializeToString())
            waiting.remove(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))


async def advertised(socket, wanted):
    """Channels by topic, until those wanted are there; and the server's own words."""
    channels, info = {}, None
    while not wanted <= set(channels):
        said = json.loads(await asyncio.wait_for(socket.recv(), 120))
        if said["op"] == "serverInfo":
            info = said
        elif said["op"] == "advertise":
            channels.update({c["topic"]: c for c in said["channels"]})
    return channels, info


class Foxglove(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.flight = rig.Flight()
        cls.addClassCleanup(cls.flight.close)

    def setUp(self):
        # Given: a payload that flies and a station that receives it.
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        at = pathlib.Path(folder.name)
        reach = f"127.0.0.1:{rig.free_port()}"
        daemon = rig.Daemon(self.flight, rig.link_tables(at / "keys", reach))
        self.addCleanup(daemon.stop)
        self.port = rig.free_port(socket.SOCK_STREAM)
        ours = f"127.0.0.1:{self.port}"
        self.station = rig.station(at / "keys", reach, at / "ground", "--no-web", "--foxglove", ours)
        self.addCleanup(self.station.wait)
        self.addCleanup(self.station.terminate)
        rig.until(lambda: rig.listens(self.port), 30, lambda: "the station does not listen")

    def connect(self, **how):
        how.setdefault("subprotocols", [PROTOCOL])
        return websockets.connect(f"ws://127.0.0.1:{self.port}/", max_size=None, **how)

    def test_a_state_is_decoded_with_the_schema_advertised(self):
        asyncio.run(self.subscribe())

    async def subscribe(self):
        async with self.connect() as client:
            self.assertEqual(client.subprotocol, PROTOCOL)
            # When: the vehicle's state and place are subscribed to.
            channels, info = await advertised(client, {TOPIC, "/alpha/target/ugv/location", "/alpha/health"})
            self.assertIn("windhover", info["name"])
            picked = [channels[TOPIC], channels["/alpha/target/ugv/location"]]
            subscriptions = [{"id": 40 + n, "channelId": c["id"]} for n, c in enumerate(picked)]
            await client.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
            # Then: states come, newer and newer, and tell the same place as the location.
            kinds, times, latest = [decoder(c) for c in picked], [], {}
            while len(times) < 20 or len(latest) < 2:
                frame = await asyncio.wait_for(client.recv(), 30)
                if isinstance(frame, str):
                    continue
                kind, subscription, time_ns = struct.unpack_from("<BIQ", frame)
                self.assertEqual(kind, 1)
                message = kinds[subscription - 40].FromString(frame[13:])
                latest[subscription] = message
                if subscription == 40:
                    self.assertEqual(message.target, "ugv")
                    stamp = message.timestamp.seconds * 10**9 + message.timestamp.nanos
                    self.assertEqual(stamp, time_ns)
                    times.append(time_ns)
            self.assertEqual(times, sorted(times))
            state, place = latest[40], latest[41]
            self.assertAlmostEqual(state.lat_deg, place.latitude, places=3)
            self.assertAlmostEqual(state.lon_deg, place.longitude, places=3)

    def test_strangers_are_turned_away(self):
        for how in ({"origin": "http://evil.example"}, {"subprotocols": ["other"]}):
            with self.subTest(**how), self.assertRaises(websockets.exceptions.InvalidStatus):
                asyncio.run(self.greet(**how))
        asyncio.run(self.greet(origin="https://app.foxglove.dev"))

    async def greet(self, **how):
        async with self.connect(**how) as client:
            self.assertEqual(json.loads(await client.recv())["op"], "serverInfo")


if __name__ == "__main__":
    unittest.main()
