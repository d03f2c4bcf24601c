"""A station on Zenoh, met by the Python client: what comes live, what was, after a restart as well.

`make test-zenoh` runs it with a windhover built with the feature `zenoh`.
"""

import json
import pathlib
import socket
import sys
import tempfile
import time
import unittest

import zenoh

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402

STATE = "windhover/alpha/target/ugv/state"


def session(mode, **endpoints):
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    for what, endpoint in endpoints.items():
        config.insert_json5(f"{what}/endpoints", json.dumps([endpoint]))
    return zenoh.open(config)


def ask(client, selector):
    """(key, payload, timestamp, encoding) of each sample, and how many errors came."""
    samples, errors = [], 0
    for reply in client.get(selector, timeout=20):
        if reply.ok is None:
            errors += 1
        else:
            sample = reply.ok
            samples.append((str(sample.key_expr), bytes(sample.payload), sample.timestamp, str(sample.encoding)))
    return samples, errors


def distinct(samples):
    """Samples as a set; of a timestamp only when, not by which session."""
    return {(key, payload, str(stamp).split("/")[0]) for key, payload, stamp, _ in samples}


class Fleet(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.at = pathlib.Path(folder.name)
        flight = rig.Flight()
        self.addCleanup(flight.close)
        self.reach = f"127.0.0.1:{rig.free_port()}"
        self.daemon = rig.Daemon(flight, rig.link_tables(self.at / "keys", self.reach))
        self.addCleanup(self.stop_daemon)
        self.endpoint = f"tcp/127.0.0.1:{rig.free_port(socket.SOCK_STREAM)}"

    def stop_daemon(self):
        if self.daemon:
            self.daemon.stop()
            self.daemon = None

    def station(self, words):
        station = rig.station(self.at / "keys", self.reach, self.at / "ground", "--no-web", "--zenoh", words)
        self.addCleanup(station.wait)
        self.addCleanup(station.terminate)
        return station

    def configured(self):
        """A station that listens, by a file with Zenoh's own configuration; and a client of it."""
        file = self.at / "zenoh.json5"
        file.write_text(
            f'{{ mode: "peer", listen: {{ endpoints: ["{self.endpoint}"] }}, '
            "scouting: { multicast: { enabled: false } } }"
        )
        station = self.station(str(file))
        port = int(self.endpoint.rsplit(":", 1)[1])
        rig.until(lambda: rig.listens(port), 30, lambda: "the station does not listen")
        return station, session("client", connect=self.endpoint)

    def test_live_latest_past_and_past_after_a_restart(self):
        # Given: a client that listens to everything.
        station, client = self.configured()
        received = []
        listening = client.declare_subscriber(
            "windhover/**", lambda s: received.append((str(s.key_expr), bytes(s.payload), s.timestamp, str(s.encoding)))
        )
        keys = {STATE, "windhover/alpha/health", "windhover/alpha/ownship/state"}
        enough = lambda: keys <= {k for k, *_ in received} and len(received) > 100  # noqa: E731
        rig.until(enough, 90, lambda: f"received {len(received)} on {set(k for k, *_ in received)}")
        listening.undeclare()
        live = list(received)
        states = [s for s in live if s[0] == STATE]
        self.assertEqual({s[3] for s in states}, {"application/protobuf;windhover.TargetState"})
        # Then: the latest is one of each key, not older than what was received.
        (latest,), errors = ask(client, STATE)
        self.assertEqual((latest[0], errors), (STATE, 0))
        self.assertGreaterEqual(latest[2].get_time(), states[-1][2].get_time())
        fleet, _ = ask(client, "windhover/*/health")
        self.assertEqual([s[0] for s in fleet], ["windhover/alpha/health"])
        # And: the past holds everything that was received, once.
        past, errors = ask(client, "windhover/alpha/**?_time=[now(-1h)..]")
        self.assertEqual(errors, 0)
        stored = distinct(past)
        self.assertEqual(len(stored), len(past), "none twice")
        self.assertEqual(len(distinct(live) - stored), 0, "all that came live")
        # And: a span is a span, and what is none is an error.
        middle = states[len(states) // 2][2].get_time().strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        some, _ = ask(client, f"{STATE}?_time=[{middle}..]")
        self.assertTrue(0 < len(some) < len([s for s in past if s[0] == STATE]), len(some))
        self.assertEqual(ask(client, f"{STATE}?_time=[nonsense"), ([], 1))
        # When: payload and station end, and the station starts again alone.
        self.stop_daemon()
        station.terminate()
        station.wait()
        client.close()
        _, client = self.configured()
        # Then: its files tell the same past.
        again, _ = ask(client, "windhover/alpha/**?_time=[now(-1h)..]")
        self.assertEqual(len(stored - distinct(again)), 0, "the same after a restart")
        client.close()

    def test_a_station_calls_a_router(self):
        router = session("router", listen=self.endpoint)
        self.addCleanup(router.close)
        received = []
        router.declare_subscriber(STATE, lambda sample: received.append(time.monotonic()))
        self.station(self.endpoint)
        rig.until(lambda: len(received) > 20, 90, lambda: f"received {len(received)}")


if __name__ == "__main__":
    unittest.main()
