"""What adaptune publishes while a robot drives."""

import json
import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from rosbags.typesys.store import Typestore

from adaptune.geometry import Poses, to_quaternions
from adaptune.selection import Selection
from online.replay import RealTimeRecord

UNKNOWN = 5.0
"""Percent of the way that an odometry is believed to err by before anything is known of it."""
_OK, _WARN, _ERROR = 0, 1, 2


class Uncertainty:
    """How uncertain a pose is, by the errors that were measured on the way.

    Errors of sub-trajectories are taken to be independent: over each metre, the variance grows by
    the squared error times the length of a sub-trajectory. The heading is taken to err by as much,
    in radians, over a sub-trajectory.

    Parameters
    ----------
    length
        Metres of a sub-trajectory.
    """

    def __init__(self, length: float):
        self._length = length
        self._share = 1e-2 * UNKNOWN
        self.position = self.rotation = 0.0  # variances: square metres, square radians

    def learn(self, selection: Selection) -> None:
        """Go on with the error of a selection: the measured one, or else the predicted."""
        for error in (selection.estimated_error, selection.predicted_error):
            if math.isfinite(error):
                self._share = 1e-2 * error
                return

    def move(self, T_previous_current: Poses) -> None:
        """Move on, by a motion of shape (4, 4)."""
        metres = float(np.linalg.norm(T_previous_current[:3, 3]))
        if math.isfinite(metres):
            self.position += self._share**2 * self._length * metres
            self.rotation += self._share**2 * metres / self._length


class RosMessages:
    """Makes messages of one ROS.

    Parameters
    ----------
    store
        Its types.
    frame
        Name of the odometry's frame.
    """

    def __init__(self, store: Typestore, frame: str):
        self._types, self._frame = store.types, frame

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _header(self, stamp: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp, 10**9)
        time = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        kind: Any = self._types["std_msgs/msg/Header"]
        # ROS 1 counts messages.
        numbered = {"seq": 0} if "seq" in kind.__dataclass_fields__ else {}
        return kind(stamp=time, frame_id=frame, **numbered)

    def _vector(self, kind: str, values: Any) -> Any:
        x, y, z = map(float, values)
        return self._make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _quaternion(self, T: Poses) -> Any:
        x, y, z, w = to_quaternions(T[None])[0].tolist()
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def odometry(
        self, stamp: int, T_odom_sensor: Poses, child: str, uncertainty: Uncertainty
    ) -> Any:
        """nav_msgs/Odometry; the twist is not known."""
        position = self._vector("Point", T_odom_sensor[:3, 3])
        pose = self._make(
            "geometry_msgs/msg/Pose", position=position, orientation=self._quaternion(T_odom_sensor)
        )
        variances = np.repeat([uncertainty.position, uncertainty.rotation], 3)
        zero = self._vector("Vector3", (0.0, 0.0, 0.0))
        twist = self._make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        # By convention -1 says that a value is not known.
        unknown = np.zeros(36)
        unknown[0] = -1.0
        return self._make(
            "nav_msgs/msg/Odometry",
            header=self._header(stamp, self._frame),
            child_frame_id=child,
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=pose,
                covariance=np.diag(variances).ravel(),
            ),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown
            ),
        )

    def transform(self, stamp: int, T_odom_sensor: Poses, child: str) -> Any:
        """tf2_msgs/TFMessage."""
        moved = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector("Vector3", T_odom_sensor[:3, 3]),
            rotation=self._quaternion(T_odom_sensor),
        )
        one = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp, self._frame),
            child_frame_id=child,
            transform=moved,
        )
        return self._make("tf2_msgs/msg/TFMessage", transforms=[one])

    def selection(self, stamp: int, selection: Selection, why_not: str) -> Any:
        """std_msgs/String with JSON: what was selected."""
        found = {
            "stamp": stamp,
            "trial": selection.trial,
            "parameters": dict(selection.parameters),
            "weights": {str(k): v for k, v in (selection.weights or {}).items()} or None,
            "predicted_error": _number(selection.predicted_error),
            "predicted_fixed": _number(selection.predicted_fixed),
            "estimated_error": _number(selection.estimated_error),
            "lost": selection.lost,
            "why_not": why_not or None,
        }
        return self._make("std_msgs/msg/String", data=json.dumps(found))

    def diagnostics(
        self, stamp: int, selection: Selection | None, status: "Status", before: "Status"
    ) -> Any:
        """diagnostic_msgs/DiagnosticArray: what happened since the message before."""
        level, said = _OK, "keeps up"
        if (status.dropped, status.missed) != (before.dropped, before.missed):
            level, said = _WARN, "was too late"
        if before.restarts:
            level, said = _ERROR, "restarts for want of healthy poses"
        if selection is not None and selection.lost:
            level, said = _ERROR, "is lost"
        values = {
            "pose after the scan [ms]": f"{1e3 * status.late:.1f}",
            "dropped scans": str(status.dropped),
            "ignored scans": str(status.ignored),
            "missed selections": str(status.missed),
        }
        if selection is not None:
            values |= {
                "trial": str(selection.trial),
                "estimated error [%]": f"{selection.estimated_error:.3f}",
                "predicted error [%]": f"{selection.predicted_error:.3f}",
            }
        kind = "diagnostic_msgs/msg/KeyValue"
        found = self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name="adaptune: odometry",
            message=said,
            hardware_id="",
            values=[self._make(kind, key=key, value=value) for key, value in values.items()],
        )
        header = self._header(stamp, "")
        return self._make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[found])


@dataclass
class Status:
    """Counts since the start, and restarts since a message."""

    dropped: int = 0
    missed: int = 0
    ignored: int = 0
    late: float = 0.0  # seconds from the newest scan to its pose
    restarts: int = 0

    @classmethod
    def of(cls, record: RealTimeRecord, ignored: int) -> Self:
        """The counts of a drive."""
        late = record.late[-1] if record.late else 0.0
        return cls(record.dropped, record.missed, ignored, late)


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None
