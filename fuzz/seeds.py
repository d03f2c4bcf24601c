"""Small whole inputs for fuzz targets whose formats a fuzzer does not find by itself in minutes: seeds.py CORPUS. Nothing but Python's
library is needed; inputs already there are kept."""

import base64
import io
import pathlib
import sqlite3
import struct
import sys
import tempfile

UTC_S = 1_795_014_245


def ulog():
    """PX4's: formats, subscriptions, one message each of three topics."""
    record = lambda kind, body: struct.pack("<HB", len(body), ord(kind)) + body  # noqa: E731
    formats = [
        "vehicle_attitude:uint64_t timestamp;float[4] q;",
        "sensor_combined:uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
        "sensor_gps:uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;float eph;uint8_t fix_type;",
    ]
    log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 10**8) + record("B", bytes(40))
    log += b"".join(record("F", text.encode()) for text in formats)
    for number, name in enumerate(("vehicle_attitude", "sensor_combined", "sensor_gps")):
        log += record("A", struct.pack("<BH", 0, number) + name.encode())
    log += record("D", struct.pack("<HQ4f", 0, 10**8, 1, 0, 0, 0)) + record("D", struct.pack("<HQ6f", 1, 10**8, 0, 0, 0, 0, 0, -9.8))
    return log + record("D", struct.pack("<HQQ3ifB", 2, 10**8, UTC_S * 10**6, 387000000, -91000000, 43000, 0.7, 3))


def dataflash():
    """ArduPilot's: its own format, then attitude, inertial unit, receiver."""
    head = lambda kind: struct.pack("<BBB", 0xA3, 0x95, kind)  # noqa: E731
    kinds = {
        129: ("ATT", "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", "<QhhhhHH", (10**7, 0, 1, 0, 2, 0, 3)),
        130: ("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", "<QBffffff", (10**7, 0, 0, 0, 0, 0, 0, -9.8)),
        131: ("GPS", "QBBIHBcLLef", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd", "<QBBIHBhiiif",
              (10**7, 0, 3, 1000, 2300, 14, 90, 387000000, -91000000, 4300, 5.0)),
    }
    log = head(128) + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    for kind, (name, letters, labels, layout, fields) in kinds.items():
        length = 3 + struct.calcsize(layout)
        log += head(128) + struct.pack("<BB4s16s64s", kind, length, name.encode(), letters.encode(), labels.encode())
        log += head(kind) + struct.pack(layout, *fields)
    return log


def tlog():
    heartbeat = bytes.fromhex("fd09000000ff01000000000000000203510403")
    return b"".join(struct.pack(">Q", UTC_S * 10**6 + k) + heartbeat + bytes(2) for k in range(3))


def srt():
    cues = ["1\n00:00:00,000 --> 00:00:00,033\n2026-11-18 15:04:05.123\n[latitude: 38.7] [longitude: -9.1] [rel_alt: 10.3 abs_alt: 512.3]\n",
            "2\n00:00:01,000 --> 00:00:01,033\nGPS (-9.1, 38.71, 19)\n"]
    return "\n".join(cues).encode()


def cdr_fix():
    return b"\0\1\0\0" + struct.pack("<iII", UTC_S, 0, 4) + b"gps\0" + struct.pack("<bxHxxxx", 0, 1) + struct.pack("<12d", 38.7, -9.1, 43, *[1.0] * 9) + b"\2"


def ros1():
    field = lambda name, value: struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value  # noqa: E731
    record = lambda head, data: struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data  # noqa: E731
    connection = field(b"op", b"\7") + field(b"conn", bytes(4)) + field(b"topic", b"/fix")
    about = field(b"topic", b"/fix") + field(b"type", b"sensor_msgs/NavSatFix") + field(b"md5sum", b"*") + field(b"message_definition", b"")
    fix = struct.pack("<IIII", 1, UTC_S, 0, 3) + b"gps" + struct.pack("<bH", 0, 1) + struct.pack("<12d", 38.7, -9.1, 43, *[1.0] * 9) + b"\2"
    message = field(b"op", b"\2") + field(b"conn", bytes(4)) + field(b"time", struct.pack("<II", UTC_S, 0))
    inside = record(connection, about) + record(message, fix)
    chunk = field(b"op", b"\5") + field(b"compression", b"none") + field(b"size", struct.pack("<I", len(inside)))
    return b"#ROSBAG V2.0\n" + record(field(b"op", b"\3") + field(b"index_pos", bytes(8)), b" " * 16) + record(chunk, inside)


def ros2():
    with tempfile.NamedTemporaryFile(suffix=".db3") as file:
        base = sqlite3.connect(file.name)
        base.execute("PRAGMA page_size=512")
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,serialization_format TEXT NOT NULL,"
                     "offered_qos_profiles TEXT NOT NULL)")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,timestamp INTEGER NOT NULL,data BLOB NOT NULL)")
        base.execute("INSERT INTO topics VALUES(1,'/fix','sensor_msgs/msg/NavSatFix','cdr','')")
        base.executemany("INSERT INTO messages VALUES(?,1,?,?)", [(k, UTC_S * 10**9 + k, cdr_fix()) for k in range(1, 4)])
        base.commit()
        base.close()
        return pathlib.Path(file.name).read_bytes()


def y4m():
    out = io.BytesIO(b"")
    out.write(b"W16 H16 F15:1 Cmono\n")
    for _ in range(2):
        out.write(b"FRAME\n" + bytes(256))
    return out.getvalue()


# 16 by 16 pixels in colour.
JPEG = base64.b64decode(
    "/9j/4AAQSkZJRgABAgAAAQABAAD/2wBDAAgEBAQEBAUFBQUFBQYGBgYGBgYGBgYGBgYHBwcICAgHBwcGBgcHCAgICAkJCQgICAgJCQoKCgwMCwsODg4RERT/"
    "xABsAAEBAQAAAAAAAAAAAAAAAAAGAwUBAQEAAAAAAAAAAAAAAAAAAAECEAACAgEEAAUFAQAAAAAAAAADBAIFAREHEgYiIRQAExYkIzFBFREAAgEEAwEBAQAA"
    "AAAAAAAAAQIDBgURBBMSFCEiFf/AABEIABAAEAMBIgACEQADEQD/2gAMAwEAAhEDEQA/ADMqi1292romk7A6djZJL2k2q9o4ZwC9JdpQUCQiAkJQVc4sRjrj"
    "JZExznDEc+23ee4r7NdsRsaqvTUqwtL/AOggkitCJEyelGx6cQ5LRixETJyL/lGPJ8xyXlHXGcq3V693DbTrYvqWrRgjV1dUYvzLHjDKSya0Sk+7FgfzSUlo"
    "OWfDmWY8pcfOO7dX2Pca/sagFDbK5Fw4FEo07k2mAS8I4gD+4g5eUpeUtf57m4COpkpGSk8ILa1QmpMH+U07EW7pyLt+ZriY1Gz8hE/EGOeocZNRl2Kks1P3"
    "fo1zhN5G3HthRA546jWxZ25Mak7RxvZPFiVzGIoCuOD8/wD/2Q=="
)


def avi():
    """The target puts RIFF before it."""
    chunk = lambda name, body: name + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)  # noqa: E731
    header = chunk(b"LIST", b"hdrl" + chunk(b"avih", struct.pack("<I", 66_667) + bytes(52)))
    body = b"AVI " + header + chunk(b"LIST", b"movi" + chunk(b"00dc", JPEG) + chunk(b"00dc", b""))
    return struct.pack("<I", len(body)) + body


def geotiff():
    """4 by 4 heights of 16 bits at 30 degrees north, 86 west; the second has no height."""
    heights = struct.pack("<16h", 10, -32768, *range(14))
    scale, tie, keys = struct.pack("<3d", 0.1, 0.1, 0), struct.pack("<6d", 0, 0, 0, -86, 30, 0), struct.pack("<8H", 1, 1, 0, 1, 1024, 0, 1, 2)
    entries = [(256, 3, 1, 4), (257, 3, 1, 4), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, "heights"), (277, 3, 1, 1),
               (278, 3, 1, 4), (279, 4, 1, len(heights)), (339, 3, 1, 2), (33550, 12, 3, "scale"), (33922, 12, 6, "tie"),
               (34735, 3, 8, "keys"), (42113, 2, 7, "void")]
    parts = {"heights": heights, "scale": scale, "tie": tie, "keys": keys, "void": b"-32768\0"}
    at, places = 8 + 2 + 12 * len(entries) + 4, {}
    for name, part in parts.items():
        places[name], at = at, at + len(part)
    ifd = b"".join(struct.pack("<HHII", tag, kind, count, places.get(value, value)) for tag, kind, count, value in entries)
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + ifd + bytes(4) + b"".join(parts.values())


def mcap():
    """A serial read and a frame, beside a chunk and in one without compression and checksum. The target puts the magic before it."""
    text = lambda value: struct.pack("<I", len(value)) + value  # noqa: E731
    record = lambda op, body: bytes([op]) + struct.pack("<Q", len(body)) + body  # noqa: E731
    field = lambda number, body: bytes([number << 3 | 2, len(body) & 127 | 128, len(body) >> 7]) + body  # noqa: E731
    stamp = field(1, b"\x08" + bytes([0xE5, 0xD5, 0xF5, 0xD7, 0x06]))
    kinds = [(b"/gps/serial", b"windhover.SerialBytes", stamp + field(2, b"$GPZDA,,,,,,*48\r\n")),
             (b"/camera/image", b"foxglove.CompressedImage", stamp + field(2, JPEG) + field(3, b"jpeg") + field(4, b"camera"))]
    records = b""
    for n, (topic, schema, data) in enumerate(kinds, 1):
        records += record(3, struct.pack("<H", n) + text(schema) + text(b"protobuf") + text(b""))
        records += record(4, struct.pack("<HH", n, n) + text(topic) + text(b"protobuf") + text(b""))
        records += record(5, struct.pack("<HIQQ", n, n, UTC_S * 10**9, UTC_S * 10**9) + data)
    chunk = record(6, struct.pack("<QQQI", 0, UTC_S * 10**9, len(records), 0) + text(b"") + struct.pack("<Q", len(records)) + records)
    configuration = record(9, struct.pack("<QQ", 0, 0) + text(b"windhover.toml") + text(b"text/plain") + struct.pack("<Q", 4) + b"[gps" + bytes(4))
    return record(1, text(b"") + text(b"seed")) + records + chunk + configuration + record(15, bytes(4)) + record(2, bytes(20)) + b"\x89MCAP0\r\n"


def receiver():
    """Bodies of sentences, a line each, to which the target gives checksums; its first byte is the length of reads."""
    return b"\x20" + "\n".join([
        "GPRMC,101112.2,A,3030.0000,S,08530.0000,W,010.0,090.5,010226,003.4,W,D", "GPGGA,101112.2,3030.0,S,08530.0,W,2,08,1.1,1577.4,M,-24.6,M,,",
        "GNGNS,101112.2,3030.0,S,08530.0,W,AAN,14,0.6,50.1,48.0,1.0,0000,V", "GPGSA,A,3,01,03,,14,,,,,,,,,3.1,3.0,1.0",
        "GPGLL,3030.0,S,08530.0,W,101112.2,A,A", "GPZDA,101112.2,18,11,2026,00,00", "GPGST,101112.2,1,1,1,0,1.0,1.0,2.0", "GPVTG,90.0,T,,M,10,N,36.0,K,A",
        "PGRME,15.0,M,45.0,M,25.0,M", "PGRMV,-2.5,-1.1,0.3", "PGRMF,223,424802,010226,140002,13,3030.0000,N,08530.0000,W,A,2,36,090,2,1"]).encode()


def compass():
    """The same for compasses; the first byte is also the format."""
    return b"\x07" + "\n".join([
        "C328.3P28.4R-12.4X55.11T22.3E000", "OHPR,320.5,0.2,-18.3,19.0", "PTNTHPR,85.9,N,-0.9,M,0.8,O", "PTNTHTM,16384,N,182,N,-182,N,13641,2454",
        "PASHR,204132.000,010.51,T,+00.39,-00.79,-00.84,0.151,0.075,0.555,1,0", "HCHDG,359.0,2.0,E,3.4,W", "HCXDR,A,-1.5,D,PITCH,A,2.5,D,ROLL",
        "GPTHS,274.0,A", "VNYMR,+085.123,-000.900,+000.800,+01.06,-00.25,+03.06,+00.005,+00.344,-09.758,-0.001,+0.002,-0.003",
        "VNQTN,0,0,0,1", "PTNL,AVR,212405.20,-10.5,Yaw,+1.5,Tilt,-2.5,Roll,12.575,3,1.4,16", "PSSN,HRP,142820.2,010120,127.5,,-1.5,0.1,,0.2,12,2,E"]).encode()


def timed():
    return b"1795014245.501 $GPZDA,,,,,,*48\n2026-11-18 16:04:05,501+0100\t$GPZDA,,,,,,*48\nWed Nov 18 15:04:05 2026: x\n"


def rows():
    return b"1.0,90,1,2,0.1,0.2,-9.8\n2026-11-18T15:04:05Z,1,2,3,,,\n"


SEEDS = {
    "logs": {"ulog": ulog, "dataflash": dataflash, "tlog": tlog, "srt": srt},
    "bags": {"ros1": ros1, "ros2": ros2},
    # The target puts the magic before it.
    "video": {"y4m": y4m, "avi": avi, "jpeg": lambda: JPEG},
    "terrain": {"tiff": geotiff},
    "mcap": {"flight": mcap},
    "gnss": {"sentences": receiver},
    "compass": {"sentences": compass},
    "mavlink": {"heartbeat": tlog},
    "texts": {"log": timed, "table": rows},
}


def main():
    for target, inputs in SEEDS.items():
        folder = pathlib.Path(sys.argv[1]) / target
        folder.mkdir(parents=True, exist_ok=True)
        for name, make in inputs.items():
            (folder / f"seed-{name}").write_bytes(make())


if __name__ == "__main__":
    main()
