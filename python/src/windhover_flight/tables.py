"""Tables out of lists of messages: a column a figure, the time of validity as index."""

import numpy as np
import pandas as pd

FIGURES = ["north_m", "east_m", "heading_rad", "speed_mps", "yaw_rate_radps"]
PLACE = ["lat_deg", "lon_deg", "height_m"]
OWNSHIP = PLACE + ["north_m", "east_m", "down_m", "vn_mps", "ve_mps", "vd_mps", "qw", "qx", "qy", "qz"]
STATUS = {0: "lost", 1: "acquiring", 2: "tracking", 3: "coasting"}
CORNERS = [f"{axis}{corner}" for corner in range(4) for axis in "uv"]


def nanoseconds(timestamp):
    return timestamp.seconds * 10**9 + timestamp.nanos


def table(times, columns):
    return pd.DataFrame(columns, index=pd.Index(times, dtype="int64", name="time_ns"))


def of(messages, columns, known=lambda _: True):
    """Fields of the same names, NaN where they are not known."""
    return {c: np.array([getattr(m, c) if known(m) else np.nan for m in messages], float) for c in columns}


def times_of(messages):
    return [nanoseconds(m.timestamp) for m in messages]


def symmetric(triangles, n):
    """Matrices out of upper triangles given row by row; NaN where there is none."""
    matrices = np.full((len(triangles), n, n), np.nan)
    rows, columns = np.triu_indices(n)
    for matrix, terms in zip(matrices, triangles):
        if len(terms) == len(rows):
            matrix[rows, columns] = matrix[columns, rows] = terms
    return matrices


def states(messages):
    head = {
        "frame": np.array([m.frame for m in messages], "int64"),
        "target": [m.target for m in messages],
        "status": [STATUS.get(m.status, "lost") for m in messages],
    }
    figures = of(messages, FIGURES + PLACE, lambda m: m.known)
    return table(times_of(messages), head | figures)


def ownship(messages):
    frame = np.array([-1 if m.between_frames else m.frame for m in messages], "int64")
    return table(times_of(messages), {"frame": frame} | of(messages, OWNSHIP))


def detections(messages):
    rows = [(m, marker) for m in messages for marker in m.markers]
    markers = [marker for _, marker in rows]
    columns = {"frame": np.array([m.frame for m, _ in rows], "int64")}
    columns |= {name: [getattr(marker, name) for marker in markers] for name in ("kind", "family", "id", "hamming")}
    columns |= of(markers, ["margin", "center_u", "center_v", "size_px"])
    for k, name in enumerate(CORNERS):
        columns[name] = np.array([x.corners[k] if len(x.corners) == 8 else np.nan for x in markers], float)
    return table([nanoseconds(m.timestamp) for m, _ in rows], columns)


def features(messages):
    rows = [(m, feature) for m in messages for feature in m.features]
    columns = {"frame": np.array([m.frame for m, _ in rows], "int64"), "id": [f.id for _, f in rows]}
    columns |= of([f for _, f in rows], ["u", "v", "sigma_px"])
    return table([nanoseconds(m.timestamp) for m, _ in rows], columns)


def optional(messages, columns):
    """Optional fields: NaN where the device did not say."""
    return {c: np.array([getattr(m, c) if m.HasField(c) else np.nan for m in messages], float) for c in columns}


def vector(messages, field, columns):
    """A repeated field of up to as many figures; NaN where there are fewer."""
    values = [list(getattr(m, field)) for m in messages]
    return {c: np.array([v[k] if k < len(v) else np.nan for v in values], float) for k, c in enumerate(columns)}


def gps(messages):
    columns = {
        "fix": np.array([m.fix for m in messages], "int64"),
        "rtk": [("", "float", "fixed")[m.rtk] if m.rtk < 3 else "" for m in messages],
        "utc_ns": pd.array([m.utc_ns if m.HasField("utc_ns") else None for m in messages], dtype="Int64"),
    }
    columns |= optional(messages, ["lat_deg", "lon_deg", "alt_msl_m", "geoid_m", "hpe_m", "vpe_m", "sats", "hdop"])
    columns |= vector(messages, "vel_ned_mps", ["vn_mps", "ve_mps", "vd_mps"])
    return table(times_of(messages), columns)


def attitude(messages):
    columns = optional(messages, ["heading_rad", "pitch_rad", "roll_rad"])
    columns["heading_is_true"] = np.array([m.heading_is_true for m in messages], bool)
    return table(times_of(messages), columns)


def inertial(messages):
    columns = vector(messages, "rate_rps", [f"rate_{axis}_rps" for axis in "xyz"])
    return table(times_of(messages), columns | vector(messages, "force_mps2", [f"force_{axis}_mps2" for axis in "xyz"]))


def fusion(messages):
    columns = {name: [getattr(m, name) for m in messages] for name in ("source", "disposition")}
    columns |= vector(messages, "innovation", ["innovation_0", "innovation_1", "innovation_2"])
    return table(times_of(messages), columns | of(messages, ["test_ratio"]))


def health(messages):
    rows = []
    for m in messages:
        row = {"fix": m.fix, "sats": m.sats, "clock_sigma_ms": m.clock_sigma_ms if m.clock_sigma_ms >= 0 else np.nan}
        for source in m.sources:
            for name in ("rate_hz", "age_ms", "total", "refused", "dropped"):
                row[f"{source.name}_{name}"] = getattr(source, name)
        for target in m.targets:
            row[f"{target.name}_status"] = STATUS.get(target.status, "lost")
            row[f"{target.name}_frames_seen"] = target.frames_seen
        row |= {f"measurements_{name}": count for name, count in sorted(m.dispositions.items())}
        row |= dict(sorted(m.figures.items())) | dict(sorted(m.words.items()))
        row["misfits"] = "; ".join(f"{x.source}: {x.figure}" for x in m.misfits)
        rows.append(row)
    return pd.DataFrame(rows, index=pd.Index(times_of(messages), dtype="int64", name="time_ns"))


def log(messages):
    level = {0: "unknown", 1: "debug", 2: "info", 3: "warning", 4: "error", 5: "fatal"}
    columns = {"level": [level.get(m.level, "unknown") for m in messages]}
    columns |= {name: [getattr(m, name) for m in messages] for name in ("name", "message")}
    return table(times_of(messages), columns)
