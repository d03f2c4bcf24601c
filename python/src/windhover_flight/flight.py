"""One class: a flight."""

import dataclasses
import datetime
import functools
import pathlib
import tomllib

import numpy as np
import pandas as pd

from . import tables
from .recording import records

# Where a target's states of each kind stand: /target/NAME/…
KINDS = {"filtered": "state", "smoothed": "smoothed", "refined": "refined", "paper": "paper"}


@dataclasses.dataclass(frozen=True)
class Frame:
    """An image as recorded."""

    number: int
    time_ns: int
    received_ns: int
    encoding: str
    width: int
    height: int
    step: int
    data: bytes


class Flight:
    """A flight or a capture of windhover: an .mcap file, or the directory of its segments.

    Everything but the images is read into memory; `frames` reads them from the file, one after another.
    Times are host time in nanoseconds, angles radians, lengths metres.
    """

    def __init__(self, path):
        self.path = pathlib.Path(path)
        self.warnings = []
        self.config_text = None
        self.began_ns = self.ended_ns = None
        self._messages = {}
        for topic, record, message in records(self.path, self.warnings):
            if topic is None:
                if message.name == "config.toml" and self.config_text is None:
                    self.config_text = message.data.decode()
                continue
            self.began_ns = record.log_time if self.began_ns is None else min(self.began_ns, record.log_time)
            self.ended_ns = record.log_time if self.ended_ns is None else max(self.ended_ns, record.log_time)
            if topic != "/camera/image":
                self._messages.setdefault(topic, []).append((record.log_time, message))

    def __repr__(self):
        return f"Flight({str(self.path)!r}, targets={self.targets}, seconds={self.seconds:.1f})"

    @property
    def seconds(self):
        """Its length."""
        return 0.0 if self.began_ns is None else (self.ended_ns - self.began_ns) / 1e9

    @property
    def topics(self):
        """Topics other than the images', with how many messages each has."""
        return {topic: len(messages) for topic, messages in sorted(self._messages.items())}

    @functools.cached_property
    def config(self):
        """The configuration it was flown with, as values; `None` where none is attached."""
        return None if self.config_text is None else tomllib.loads(self.config_text)

    @functools.cached_property
    def targets(self):
        """Names of the targets of which there are states."""
        named = (topic.split("/") for topic in self._messages if topic.startswith("/target/"))
        return sorted({parts[2] for parts in named if len(parts) == 4})

    @property
    def datum(self):
        """Origin of the NED frame: latitude and longitude in degrees, height above the ellipsoid; `None` where none was
        settled. One that moved holds."""
        messages = self._messages.get("/datum")
        return (messages[-1][1].lat_deg, messages[-1][1].lon_deg, messages[-1][1].height_m) if messages else None

    def utc(self, time_ns):
        """UTC of an instant of the flight; `None` where the receiver never reported the date with a fix."""
        ahead = [m.utc_minus_host_ns for _, m in self._messages.get("/health", []) if m.HasField("utc_minus_host_ns")]
        if not ahead:
            return None
        epoch = datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
        return epoch + datetime.timedelta(microseconds=(int(time_ns) + ahead[-1]) / 1e3)

    def _of_target(self, target, kind):
        if kind not in KINDS:
            raise ValueError(f"{kind!r} is none of {', '.join(KINDS)}")
        if target not in self.targets:
            raise KeyError(f"no target {target!r}; there are {self.targets}")
        return [message for _, message in self._messages.get(f"/target/{target}/{KINDS[kind]}", [])]

    def states(self, target, kind="filtered"):
        """States of a target: a row a camera frame."""
        return tables.states(self._of_target(target, kind))

    def covariance(self, target, kind="filtered"):
        """n×5×5 covariances of (north, east, heading, speed, yaw rate), rows as in `states`."""
        return tables.symmetric([message.covariance for message in self._of_target(target, kind)], 5)

    def sigmas(self, target, kind="filtered"):
        """One-sigma of each figure, rows as in `states`."""
        variances = np.diagonal(self.covariance(target, kind), axis1=1, axis2=2)
        return pd.DataFrame(np.sqrt(variances), columns=tables.FIGURES, index=self.states(target, kind).index)

    def _own_states(self, topic):
        return sorted((m for _, m in self._messages.get(topic, [])), key=lambda m: tables.nanoseconds(m.timestamp))

    @functools.cached_property
    def _own(self):
        return self._own_states("/ownship/state")

    @functools.cached_property
    def ownship_refined(self):
        """The same as `windhover refine` found it from the whole flight."""
        return tables.ownship(self._own_states("/ownship/refined"))

    @functools.cached_property
    def ownship_refined_covariance(self):
        """n×9×9, rows as in `ownship_refined`."""
        return tables.symmetric([m.covariance for m in self._own_states("/ownship/refined")], 9)

    @functools.cached_property
    def ownship(self):
        """The helicopter's own state; `frame` is -1 between frames."""
        return tables.ownship(self._own)

    @functools.cached_property
    def ownship_covariance(self):
        """n×9×9 of (north, east, down; their velocities; small rotations about them), rows as in `ownship`."""
        return tables.symmetric([message.covariance for message in self._own], 9)

    def _table(self, topic, make):
        return make([message for _, message in self._messages.get(topic, [])])

    @functools.cached_property
    def detections(self):
        """A row a marker and frame; pixels, the centre of the top-left pixel is (0, 0)."""
        return self._table("/camera/detections", tables.detections)

    @functools.cached_property
    def features(self):
        """A row a ground feature and frame."""
        return self._table("/camera/detections", tables.features)

    @functools.cached_property
    def gps(self):
        """What the receiver said, a row an epoch."""
        return self._table("/gps/epoch", tables.gps)

    @functools.cached_property
    def compass(self):
        """What the compass said."""
        return self._table("/compass/attitude", tables.attitude)

    @functools.cached_property
    def attitude(self):
        """What a second source of attitude said."""
        return self._table("/attitude/samples", tables.attitude)

    @functools.cached_property
    def imu(self):
        """Rates and specific forces in the sensor's own axes."""
        return self._table("/imu/samples", tables.inertial)

    @functools.cached_property
    def fusion(self):
        """What became of each measurement."""
        return self._table("/fusion", tables.fusion)

    @functools.cached_property
    def health(self):
        """Once a second: rates and ages of sources, states of targets, figures of the daemon; a column a figure."""
        return self._table("/health", tables.health)

    @functools.cached_property
    def log(self):
        """The flight's notices."""
        return self._table("/log", tables.log)

    def frames(self):
        """Images as recorded, in the order of the file. Numbers count them as the tables do."""
        number = 0
        for topic, record, message in records(self.path, []):
            if topic != "/camera/image":
                continue
            raw = hasattr(message, "encoding")
            yield Frame(
                number, tables.nanoseconds(message.timestamp), record.log_time, message.encoding if raw else message.format,
                message.width if raw else 0, message.height if raw else 0, message.step if raw else 0, message.data,
            )
            number += 1
