"""Small whole inputs for fuzz targets whose formats a fuzzer does not find by itself in minutes: seeds.py CORPUS. Nothing but Python's
library is needed; inputs already there are kept."""

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


SEEDS = {
    "logs": {"ulog": ulog, "dataflash": dataflash, "tlog": tlog, "srt": srt},
    "bags": {"ros1": ros1, "ros2": ros2},
    # The target puts the magic before it.
    "video": {"y4m": y4m},
}


def main():
    for target, inputs in SEEDS.items():
        folder = pathlib.Path(sys.argv[1]) / target
        folder.mkdir(parents=True, exist_ok=True)
        for name, make in inputs.items():
            (folder / f"seed-{name}").write_bytes(make())


if __name__ == "__main__":
    main()
