"""Position reports and metrics of a flying payload and its station: `taky`'s server and `pytak`'s reader of Cursor on Target, a TLS
server, Debian's Prometheus."""

import asyncio
import datetime
import ipaddress
import json
import pathlib
import shutil
import socket
import ssl
import subprocess
import sys
import tempfile
import threading
import unittest
import urllib.parse
import urllib.request
import xml.etree.ElementTree as ET

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from prometheus_client.openmetrics.parser import text_string_to_metric_families

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/python"))

import rig  # noqa: E402


def events_of(data):
    """Whole events in a stream of them."""
    parts = data.split(b"</event>")
    return [ET.fromstring(part[part.index(b"<event") :] + b"</event>") for part in parts[:-1] if b"<event" in part]


def certificate(name, issuer=None, ca=False):
    """A certificate and its key; signed by `issuer`, a pair of the same kind, or by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.timezone.utc)
    signer, signing = issuer if issuer else (None, key)
    builder = (
        x509.CertificateBuilder().subject_name(subject).issuer_name(signer.subject if signer else subject)
        .public_key(key.public_key()).serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1)).not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
    )
    if not ca:
        names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return builder.sign(signing, hashes.SHA256()), key


def write(folder, name, pair):
    made, key = pair
    (folder / f"{name}.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
    private = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    (folder / f"{name}.key").write_bytes(private)
    (folder / f"{name}.key").chmod(0o600)


class TlsServer(threading.Thread):
    """Keeps what clients with a certificate of ours say."""

    def __init__(self, folder, port):
        super().__init__(daemon=True)
        self.data = b""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(folder / "server.pem", folder / "server.key")
        context.load_verify_locations(folder / "authority.pem")
        context.verify_mode = ssl.CERT_REQUIRED
        self.listener = context.wrap_socket(socket.create_server(("127.0.0.1", port)), server_side=True)

    def run(self):
        while True:
            try:
                stream, _ = self.listener.accept()
                while part := stream.recv(65536):
                    self.data += part
            except ssl.SSLError:
                continue
            except OSError:
                return


class Reports(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        # Given: a payload that flies and tells its metrics, a TAK server, a station that reports to all of them.
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.at = pathlib.Path(folder.name)
        cls.flight = rig.Flight()
        cls.addClassCleanup(cls.flight.close)
        port, tcp = rig.free_port(), socket.SOCK_STREAM
        cls.web, cls.metrics, cls.tak, secure = (rig.free_port(tcp) for _ in range(4))
        cls.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        cls.udp.bind(("127.0.0.1", 0))
        cls.udp.settimeout(60)
        cls.addClassCleanup(cls.udp.close)
        authority = certificate("authority", ca=True)
        for name, pair in (("authority", authority), ("server", certificate("server", authority)), ("client", certificate("client", authority))):
            write(cls.at, name, pair)
        cls.secure = TlsServer(cls.at, secure)
        cls.secure.start()
        cls.addClassCleanup(cls.secure.listener.close)
        (cls.at / "taky.conf").write_text(
            f"[taky]\nhostname=localhost\nbind_ip=127.0.0.1\nroot_dir={cls.at}\n[cot_server]\nport={cls.tak}\n[ssl]\nenabled=false\n")
        taky = subprocess.Popen([pathlib.Path(sys.executable).with_name("taky"), "-c", cls.at / "taky.conf"],
                                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=cls.at)
        cls.addClassCleanup(taky.wait)
        cls.addClassCleanup(taky.terminate)
        rig.until(lambda: rig.listens(cls.tak), 20, lambda: "taky does not listen")
        tables = rig.link_tables(cls.at / "keys", f"127.0.0.1:{port}") + f'[daemon]\nmetrics = "127.0.0.1:{cls.metrics}"\n'
        daemon = rig.Daemon(cls.flight, tables)
        cls.addClassCleanup(daemon.stop)
        serve = [
            "--web", f"127.0.0.1:{cls.web}", "--cot", f"udp://127.0.0.1:{cls.udp.getsockname()[1]}", "--cot", f"tcp://127.0.0.1:{cls.tak}",
            "--cot", f"tls://localhost:{secure}", "--cot-authority", cls.at / "authority.pem",
            "--cot-certificate", cls.at / "client.pem", "--cot-key", cls.at / "client.key",
        ]
        station = rig.station(cls.at / "keys", f"127.0.0.1:{port}", cls.at / "ground", *serve)
        cls.addClassCleanup(station.wait)
        cls.addClassCleanup(station.terminate)
        rig.until(lambda: "Point" in cls.fetch(cls.web, "vehicles.geojson"), 120, lambda: cls.fetch(cls.web, "vehicles.geojson"))

    @classmethod
    def fetch(cls, port, name):
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/{name}") as answer:
                return answer.read().decode()
        except OSError:
            return ""

    def check(self, events):
        """Vehicle and helicopter are where the station has them."""
        by_kind = {event.get("type"): event for event in events}
        self.assertLessEqual({"a-f-G-E-V", "a-f-A-M-H-Q"}, set(by_kind))
        feature = json.loads(self.fetch(self.web, "vehicles.geojson"))["features"][0]
        lon, lat = feature["geometry"]["coordinates"]
        point = by_kind["a-f-G-E-V"].find("point")
        self.assertAlmostEqual(float(point.get("lat")), lat, delta=2e-4)
        self.assertAlmostEqual(float(point.get("lon")), lon, delta=2e-4)
        self.assertTrue(0.05 < float(point.get("ce")) < 10, point.attrib)
        self.assertEqual(float(point.get("le")), 9999999.0)
        point = by_kind["a-f-A-M-H-Q"].find("point")
        self.assertTrue(0.05 < float(point.get("ce")) < 10 and 0 <= float(point.get("le")) < 20, point.attrib)
        # The ground lies at 6 m above the ellipsoid, the helicopter some 20 m above it.
        self.assertAlmostEqual(float(point.get("hae")), 26, delta=8)

    def test_datagrams_are_whole_events(self):
        events = []
        while len({event.get("type") for event in events}) < 2:
            events += events_of(self.udp.recv(65536))
        self.check(events)
        stale, start = (datetime.datetime.fromisoformat(events[0].get(name)) for name in ("stale", "start"))
        self.assertEqual((stale - start).total_seconds(), 5)

    def test_taky_hands_them_to_its_clients_and_pytak_reads_them(self):
        import pytak

        async def listen():
            reader, writer = await pytak.protocol_factory({"COT_URL": f"tcp://127.0.0.1:{self.tak}"})
            writer.write(b'<event version="2.0" uid="test" type="a-f-G" how="m-g" time="2026-01-01T00:00:00Z" '
                         b'start="2026-01-01T00:00:00Z" stale="2036-01-01T00:00:00Z"><point lat="0" lon="0" hae="0" ce="1" le="1"/>'
                         b'<detail><contact callsign="test"/></detail></event>')
            worker = pytak.RXWorker(asyncio.Queue(), {}, reader)
            events = []
            while len({event.get("type") for event in events} & {"a-f-G-E-V", "a-f-A-M-H-Q"}) < 2:
                data = await asyncio.wait_for(worker.readcot(), 60)
                events += events_of(data + (b"" if data.endswith(b"</event>") else b"</event>"))
            writer.close()
            return events

        self.check(asyncio.run(listen()))

    def test_tls_with_a_certificate_of_ones_own(self):
        rig.until(lambda: len({event.get("type") for event in events_of(self.secure.data)}) >= 2, 60, lambda: self.secure.data[-500:])
        self.check(events_of(self.secure.data))

    def test_metrics_of_daemon_and_station(self):
        said = rig.until(lambda: "windhover_target_sigma" in (text := self.fetch(self.metrics, "metrics")) and text, 60,
                         lambda: self.fetch(self.metrics, "metrics"))
        families = {family.name: family for family in text_string_to_metric_families(said)}
        rates = {sample.labels["source"]: sample.value for sample in families["windhover_source_rate_hertz"].samples}
        self.assertAlmostEqual(rates["gps"], 5, delta=1.5)
        status = {s.labels["status"]: s.value for s in families["windhover_target_status"].samples if s.labels["target"] == "ugv"}
        self.assertEqual(sum(status.values()), 1)
        self.assertEqual(families["windhover_measurements"].type, "counter")
        said = rig.until(lambda: "windhover_link_up" in (text := self.fetch(self.web, "metrics")) and text, 60,
                         lambda: self.fetch(self.web, "metrics"))
        station = {family.name: family for family in text_string_to_metric_families(said)}
        self.assertEqual([(s.labels, s.value) for s in station["windhover_link_up"].samples], [({"payload": "alpha"}, 1)])

    def test_prometheus_scrapes_both(self):
        if not shutil.which("prometheus"):
            rig.leave_out(self, "prometheus is not installed")
        port = rig.free_port(socket.SOCK_STREAM)
        (self.at / "prometheus.yml").write_text(
            "global: {scrape_interval: 1s}\nscrape_configs:\n- job_name: windhover\n  static_configs:\n"
            f"  - targets: ['127.0.0.1:{self.metrics}', '127.0.0.1:{self.web}']\n")
        words = ["prometheus", f"--config.file={self.at}/prometheus.yml", f"--storage.tsdb.path={self.at}/prometheus",
                 f"--web.listen-address=127.0.0.1:{port}"]
        run = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.addCleanup(run.wait)
        self.addCleanup(run.terminate)

        def found():
            query = urllib.parse.quote("windhover_source_messages_total{source='gps'} > 0")
            answer = self.fetch(port, f"api/v1/query?query={query}")
            return answer and len(json.loads(answer)["data"]["result"]) == 2

        rig.until(found, 60, lambda: self.fetch(port, "api/v1/targets"))


if __name__ == "__main__":
    unittest.main()
