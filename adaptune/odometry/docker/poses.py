"""The poses that a ROS system publishes, as messages of poses or as transforms between frames."""

import struct
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from rosbags.serde import SerdeError

from adaptune.errors import OdometryError
from adaptune.geometry import Poses, to_pose, to_quaternions
from adaptune.recording.pose_messages import POSES, TRANSFORMS, Pose, message_stamp
from adaptune.ros.relay import Relay

_FLOOD = 2000  # messages of a second that are too many


class PoseReader:
    """Hears a topic, and reads its poses.

    Of transforms, the poses are those of the sensor's `frame`, by way of all frames between, or
    those of the only frame that moves. `fixed` holds frames that do not move, each with its parent
    and its pose in that; those on ``/tf_static`` are heard, too.
    """

    def __init__(
        self,
        link: Relay,
        topic: str,
        frame: str = "lidar",
        fixed: Mapping[str, tuple[str, Any]] | None = None,
    ):
        self.fault = ""  # what goes wrong with the messages
        self.lacking = ""  # why transforms hold no pose
        self.about = ""  # of which frame the poses are, and in which other one
        self._link, self.topic, self._frame = link, topic, frame
        self._fixed = {child: (into, to_pose(T)) for child, (into, T) in (fixed or {}).items()}
        self._moving: dict[str, tuple[str, Poses]] = {}
        self._n, self._first = 0, np.inf

    def hear(self, take: Callable[[str, bytes], None]) -> None:
        """Have messages taken, unless they are too many."""

        def count(kind: str, data: bytes) -> None:
            now = time.monotonic()
            self._n, self._first = self._n + 1, min(self._first, now)
            if self._n > _FLOOD * max(1.0, now - self._first):
                self.fault = f"it publishes more than {_FLOOD} messages a second on {self.topic}"
            take(kind, data)

        self._link.record(self.topic, count)
        if self.topic.endswith("/tf"):
            self._link.record(f"{self.topic}_static", self._fix)

    def read(self, kind: str, data: bytes) -> list[Pose]:
        """The poses in a message; none if it is of another type."""
        if kind not in POSES:
            return []
        try:
            message = self._link.decode(data, kind)
            if kind in TRANSFORMS:
                return self._sensor(self._frames(message, self._moving))
            if child := getattr(message, "child_frame_id", ""):
                self.about = f"{child} in {message.header.frame_id}"
            return POSES[kind](message)
        except (SerdeError, struct.error, ValueError, IndexError) as error:
            raise OdometryError(f"it publishes a {kind} that cannot be read ({error})") from error

    def _fix(self, kind: str, data: bytes) -> None:
        if kind in TRANSFORMS:
            self._frames(self._link.decode(data, kind), self._fixed)

    @staticmethod
    def _frames(message: Any, known: dict[str, tuple[str, Poses]]) -> dict[str, int]:
        """Note a message's frames; the stamp of each."""
        stamps = {}
        for stamped in message.transforms:
            p, q = stamped.transform.translation, stamped.transform.rotation
            child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
            known[child] = parent, matrix(p, q)
            stamps[child] = message_stamp(stamped)
        return stamps

    def _sensor(self, stamps: Mapping[str, int]) -> list[Pose]:
        """The sensor's pose, if the frame that carries it has moved now."""
        frame, carrier = self._frame, ""
        if frame not in {**self._fixed, **self._moving}:
            if len(self._moving) != 1:
                self.lacking = (
                    f"{self.topic} moves {', '.join(sorted(self._moving))}, and does not say where "
                    f"{frame} is; name the sensor's frame as odometry.settings.frame"
                )
                return []
            (frame,) = self._moving
        begin, T, passed = frame, np.eye(4), set[str]()
        while frame not in passed and (frame in self._moving or frame in self._fixed):
            passed.add(frame)
            carrier = carrier or (frame if frame in self._moving else "")
            parent, T_parent_frame = self._moving.get(frame) or self._fixed[frame]
            frame, T = parent, T_parent_frame @ T
        self.about = f"{begin} in {frame}"
        self.lacking = "" if carrier else f"nothing on {self.topic} moves {begin}"
        if carrier not in stamps:
            return []
        types, q = self._link.store.types, np.full(4, np.nan)
        if np.isfinite(T).all():
            (q,) = to_quaternions(T[None])
        position = types["geometry_msgs/msg/Vector3"](*T[:3, 3].tolist())
        rotation = types["geometry_msgs/msg/Quaternion"](*q.tolist())
        return [(stamps[carrier], frame, position, rotation)]


def matrix(p: Any, q: Any) -> Poses:
    """A pose of shape (4, 4) from a position and a quaternion, NaN where they are none."""
    try:
        T: Poses = to_pose((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    except ValueError:
        return np.full((4, 4), np.nan)
    return T
