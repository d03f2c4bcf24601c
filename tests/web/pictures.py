"""The pictures of README and book, made from the running program: `make pictures` writes docs/book/pictures.

A station with a payload that flies, the report of a simulated flight, and the daemon's log as a terminal shows it.
"""

import html
import pathlib
import socket
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402
from browser import Browser  # noqa: E402

PICTURES = ROOT / "docs/book/pictures"
TERMINAL = """<body style="margin:0;background:#14181d;color:#e6eaef;font:13px/1.5 monospace;padding:14px 18px">
<pre style="margin:0;white-space:pre-wrap;overflow-wrap:anywhere">{}</pre></body>"""


def station(browser, flight, at):
    port, web = rig.free_port(), rig.free_port(socket.SOCK_STREAM)
    address = f"127.0.0.1:{port}"
    daemon = rig.Daemon(flight, rig.link_tables(at / "keys", address))
    ground = rig.station(at / "keys", address, at / "ground", "--web", f"127.0.0.1:{web}")
    try:
        rig.until(lambda: rig.listens(web), 60, lambda: "the station serves no page")
        browser.size(1280, 800)
        browser.open(f"http://127.0.0.1:{web}/")
        shown = lambda: browser.text("target-status") == "tracking" and "marker" in browser.text("camera-note")  # noqa: E731
        rig.until(shown, 180, lambda: f"nothing is tracked: {daemon.text()}")
        trail = "fleet.get('alpha').targets.get('ugv').trail.length"
        rig.until(lambda: browser.ask(trail) > 250, 120, lambda: "the trail does not grow")
        browser.ask("draw.last = 0, dirty = true")
        rig.until(lambda: browser.ask("!dirty"), 20, lambda: "the page does not draw")
        browser.photograph(PICTURES / "station.png")
    finally:
        ground.terminate()
        ground.wait()
        daemon.stop()


def report(browser, at):
    capture, flight, page = at / "flight.mcap", at / "result.mcap", at / "report.html"
    rig.windhover("simulate", capture, "--scenario", "follow", "--duration", 20, "--scale", 0.5)
    run = [rig.BINARY, "replay", capture, "--out", flight, "--log"]
    log = subprocess.run(list(map(str, run)), capture_output=True, text=True, check=True).stderr
    rig.windhover("report", flight, "--truth", at / "flight.truth.csv", "--out", page)
    browser.size(1120, 1300)
    browser.open(page.as_uri())
    rig.until(lambda: browser.ask("document.readyState") == "complete", 30, lambda: "the report does not load")
    browser.photograph(PICTURES / "report.png")
    events = [line for line in log.splitlines() if "event=" in line and "event=health" not in line]
    health = [line for line in log.splitlines() if "event=health" in line]
    lines = events[:6] + health[-3:]
    (at / "terminal.html").write_text(TERMINAL.format(html.escape("\n".join(lines))))
    browser.size(1120, 24 + 22 * len(lines) * 2)
    browser.open((at / "terminal.html").as_uri())
    rig.until(lambda: "event=" in browser.ask("document.body?.textContent ?? ''"), 30, lambda: "no terminal")
    height = browser.ask("document.querySelector('pre').offsetHeight + 28")
    browser.size(1120, int(height))
    browser.photograph(PICTURES / "terminal.png")


def main():
    PICTURES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        at, browser = pathlib.Path(folder), Browser()
        try:
            report(browser, at)
            flight = rig.Flight("follow")
            try:
                station(browser, flight, at)
            finally:
                flight.close()
        finally:
            browser.close()
    print("\n".join(str(picture) for picture in sorted(PICTURES.glob("*.png"))))


if __name__ == "__main__":
    main()
