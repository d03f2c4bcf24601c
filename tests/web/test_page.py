"""The station's page in headless Chromium, fed by a running payload: it loads, moves, survives a cut.

`make test-web` runs it and leaves its pictures in target/web.
"""

import pathlib
import socket
import sys
import tempfile
import unittest

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402
from browser import Browser  # noqa: E402
from relay import Relay  # noqa: E402

PICTURES = ROOT / "target/web"
# Cards beside the map that hide a part of their content, or of their neighbour.
CLIPPED = """(() => {
  const cards = [...document.querySelectorAll("#column .card")].filter((card) => card.id !== "events-card");
  const low = (card) => card.getBoundingClientRect().bottom;
  return cards.filter((card, i) => card.scrollHeight > card.clientHeight + 1
    || (i > 0 && low(cards[i - 1]) > card.getBoundingClientRect().top)).map((card) => card.id).join(" ");
})()"""


class Page(unittest.TestCase):
    def setUp(self):
        # Given: a payload that flies, a radio that can be cut, a station with its page.
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        at = pathlib.Path(folder.name)
        flight = rig.Flight()
        self.addCleanup(flight.close)
        port, web = rig.free_port(), rig.free_port(socket.SOCK_STREAM)
        daemon = rig.Daemon(flight, rig.link_tables(at / "keys", f"127.0.0.1:{port}"))
        self.addCleanup(daemon.stop)
        self.relay = Relay(port)
        self.addCleanup(self.relay.stop)
        reach = f"127.0.0.1:{self.relay.port}"
        station = rig.station(at / "keys", reach, at / "ground", "--web", f"127.0.0.1:{web}")
        self.addCleanup(station.wait)
        self.addCleanup(station.terminate)
        self.browser = Browser()
        self.addCleanup(self.browser.close)
        self.url = f"http://127.0.0.1:{web}/"
        PICTURES.mkdir(parents=True, exist_ok=True)
        rig.until(lambda: rig.listens(web), 30, lambda: "the station serves no page")

    def becomes(self, name, test, seconds=60):
        say = lambda: f"{name} is {self.browser.text(name)!r}; {self.browser.errors}"  # noqa: E731
        return rig.until(lambda: test(self.browser.text(name)) and self.browser.text(name), seconds, say)

    def test_it_loads_moves_and_survives_a_cut(self):
        browser = self.browser
        browser.size(1280, 900)
        browser.open(self.url)
        # Then: it is live, the vehicle is tracked, its picture and its plots are there.
        self.becomes("server", lambda text: text == "live")
        self.becomes("target-status", lambda text: text == "tracking", 120)
        self.becomes("camera-note", lambda text: "marker" in text)
        self.becomes("sensors", lambda text: "camera" in text and "satellites" in text)
        # And: it moves.
        before = self.becomes("coordinates", lambda text: "," in text)
        trail = browser.ask("fleet.get('alpha').targets.get('ugv').trail.length")
        self.becomes("coordinates", lambda text: text not in ("", before))
        more = lambda: browser.ask("fleet.get('alpha').targets.get('ugv').trail.length") > trail + 50  # noqa: E731
        rig.until(more, 60, lambda: "the trail does not grow")
        self.becomes("flight", lambda text: "recording 0:" in text)
        self.becomes("to-vehicle", lambda text: " m " in text and "°" in text)
        self.becomes("target-age", lambda text: text.endswith(" s"))
        for width, height in (1280, 720), (1280, 900), (1440, 900), (1920, 1080):
            browser.size(width, height)
            rig.until(lambda: browser.ask("innerHeight") == height, 10, lambda: "the window keeps its size")
            self.assertEqual(browser.ask(CLIPPED), "", f"cards cut off at {width}x{height}")
            self.assertGreater(browser.ask("document.getElementById('camera').clientHeight") / height, 0.55, "the picture is large")
            size = browser.ask("parseFloat(getComputedStyle(document.getElementById('target-status')).fontSize)")
            self.assertGreaterEqual(size, 24, "the status is read in the sun")
            browser.ask("draw.last = 0, dirty = true")
            rig.until(lambda: browser.ask("!dirty"), 10, lambda: "it does not draw")
            browser.photograph(PICTURES / f"desktop-{width}x{height}.png")
        browser.size(390, 844, phone=True)
        rig.until(lambda: browser.ask("innerWidth") == 390, 10, lambda: "no phone")
        self.assertLessEqual(browser.ask("document.documentElement.scrollWidth"), 390, "nothing sticks out")
        browser.ask("draw.last = 0, dirty = true")
        rig.until(lambda: browser.ask("!dirty"), 10, lambda: "it does not draw")
        browser.photograph(PICTURES / "phone.png")
        browser.size(1280, 900)
        # When: the radio is cut, then the page says that what it shows is old.
        self.relay.cut = True
        self.becomes("target-status", lambda text: text == "no news", 20)
        self.becomes("map-note", lambda text: "silent" in text or "not connected" in text, 20)
        rig.until(lambda: browser.ask("alarm.state"), 20, lambda: "nothing calls the operator")
        rig.until(lambda: "⚠" in browser.ask("document.title"), 5, lambda: "the title does not flash")
        browser.photograph(PICTURES / "cut.png")
        # When: it is back, then so are the estimates, and what was missed fills in.
        self.relay.cut = False
        self.becomes("target-status", lambda text: text in ("tracking", "coasting"), 30)
        rig.until(lambda: browser.ask("document.title") == "windhover", 5, lambda: "the title is as it was")
        self.becomes("link", lambda text: "nothing up to 2 s ago" in text, 60)
        gaps = lambda: browser.ask("fleet.get('alpha').targets.get('ugv').trail.filter(p => p.gap).length")  # noqa: E731
        rig.until(lambda: gaps() == 0, 60, lambda: f"{gaps()} gaps in the trail")
        browser.photograph(PICTURES / "after.png")
        self.assertEqual(browser.errors, [])


if __name__ == "__main__":
    unittest.main()
