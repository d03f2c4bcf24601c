"""A running daemon that flies a simulated flight: serial lines over pseudo-terminals, a recorded camera."""

import os
import pathlib
import pty
import re
import signal
import socket
import subprocess
import tempfile
import threading
import time
import tty

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

ROOT = pathlib.Path(__file__).resolve().parents[2]
BINARY = ROOT / "target/debug/windhover"


def leave_out(test, why):
    """Skips a test, and has the checks say so at their end."""
    subprocess.run(["sh", ROOT / ".ci/skip", test.id(), why], check=True)
    test.skipTest(why)


def windhover(*args):
    done = subprocess.run([BINARY, *map(str, args)], capture_output=True, text=True)
    if done.returncode:
        raise AssertionError(f"windhover {args[0]} gave {done.returncode}: {done.stderr}")
    return done.stdout


def free_port(kind=socket.SOCK_DGRAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def listens(port):
    """Whether somebody listens at a TCP port of this computer."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def until(what, seconds, message):
    """Waits until `what()` gives something true, and gives it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = what()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError(message())


class Flight:
    """A simulated flight, taken apart into what devices deliver. Made once, flown often."""

    def __init__(self, scenario="hover20", seconds=60, fps=10, scale=0.5):
        self.folder = tempfile.TemporaryDirectory()
        self.at = pathlib.Path(self.folder.name)
        capture = self.at / "capture.mcap"
        windhover("simulate", capture, "--scenario", scenario, "--duration", seconds, "--scale", scale, "--fps", fps)
        camera = self.at / "camera"
        camera.mkdir()
        self.serial, rows, start = [], ["time_s,file"], None
        with open(capture, "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            self.config = next(reader.iter_attachments()).data.decode()
            for _, channel, message, decoded in reader.iter_decoded_messages():
                start = start or message.log_time
                at = (message.log_time - start) / 1e9
                if channel.topic == "/camera/image":
                    name = f"{len(rows):05}.jpg"
                    (camera / name).write_bytes(decoded.data)
                    rows.append(f"{at:.4f},{name}")
                else:
                    self.serial.append((at, channel.topic.split("/")[1], decoded.data))
        (camera / "times.csv").write_text("\n".join(rows) + "\n")

    def close(self):
        self.folder.cleanup()


class Daemon:
    """`windhover run` on a flight, with more configuration appended (TOML of whole tables); `inside` are the
    words that bring a program to where it is to run."""

    def __init__(self, flight, tables, inside=()):
        self.folder = tempfile.TemporaryDirectory()
        self.at = pathlib.Path(self.folder.name)
        self.ends, config = {}, flight.config
        for source, device in (("gps", "/dev/ttyS0"), ("compass", "/dev/ttyS1")):
            far, near = pty.openpty()
            tty.setraw(near)
            config = config.replace(f'"{device}"', f'"{os.ttyname(near)}"')
            self.ends[source] = far
            os.close(near)
        config = config.replace('"/dev/video0"', f'"capture-loop:{flight.at / "camera"}"')
        (self.at / "card").mkdir()
        config = config.replace('"/var/lib/windhover"', f'"{self.at / "card"}"')
        for table in re.findall(r"^\[(\w+)\]", tables, re.M):
            config = re.sub(rf"^\[{table}\]\n(?:(?!\[).*\n?)*", "", config, flags=re.M)
        tables = tables.replace('"/var/lib/windhover"', f'"{self.at / "card"}"')
        (self.at / "windhover.toml").write_text(config + "\n" + tables)
        self.log = self.at / "log"
        self.stopped = threading.Event()
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                [*inside, BINARY, "run", "--config", self.at / "windhover.toml"], stdin=subprocess.DEVNULL, stderr=log
            )
        self.feeder = threading.Thread(target=self.feed, args=(flight,))
        self.feeder.start()

    def feed(self, flight):
        while not self.stopped.is_set():
            began = time.monotonic()
            for at, source, data in flight.serial:
                if self.stopped.wait(max(0.0, began + at - time.monotonic())):
                    return
                os.write(self.ends[source], data)

    def text(self):
        return self.log.read_text()

    def wait(self, *words, seconds=60):
        def found():
            return any(all(word in line for word in words) for line in self.text().splitlines())

        until(found, seconds, lambda: f"no line with {words}:\n{self.text()}")

    def stop(self):
        self.stopped.set()
        self.feeder.join()
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for end in self.ends.values():
            os.close(end)
        self.folder.cleanup()


def link_tables(keys, address):
    """Makes keys for a payload `alpha` and a station `base`; gives the configuration of the payload's link."""
    for words in (["authority"], ["payload", "alpha"], ["station", "base"]):
        windhover("keys", *words, "--dir", keys)
    return (
        f'[link]\nenabled = true\nlisten = "{address}"\nauthority = "{keys}/authority.pem"\n'
        f'certificate = "{keys}/payload-alpha.pem"\nkey = "{keys}/payload-alpha.key"\n'
    )


def station(keys, address, out, *more, binary=BINARY, inside=(), stdout=subprocess.DEVNULL):
    """A ground station `base` that calls a payload."""
    return subprocess.Popen(
        [
            *inside, binary, "ground", "--connect", address, "--authority", keys / "authority.pem",
            "--certificate", keys / "station-base.pem", "--out", out, *more,
        ],
        stdout=stdout,
    )


def kept(folder):
    """Numbers a station keeps of its only payload, by flight: a list as they stand in the files, and how many
    of them are states."""
    numbers, states = {}, 0
    for path in sorted(folder.glob("*/*/*.mcap")):
        with open(path, "rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                numbers.setdefault(path.parent.name, []).append(message.sequence)
                states += channel.topic.endswith("/state")
    return numbers, states
