"""adaptune's keyframe GICP, as the programs of the reference image run it."""

import os
import sys
from typing import Any

import numpy as np

from adaptune.geometry import to_quaternions
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.recording.scan import Scan
from adaptune.space import Categorical, Integer

POINTS_TOPIC = "/points"
FRAMES = {
    "camera": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "lidar": np.eye(3),
}
"""From the LiDAR's axes to those that poses are given in."""
_FLOAT32 = 7


def limits() -> dict[str, tuple[float, float, float]]:
    """Lowest value, highest value and default of each parameter."""
    found = {}
    for name, parameter in KeyframeGicp.space.parameters.items():
        if isinstance(parameter, Categorical):
            low, high = min(parameter.choices), max(parameter.choices)
        else:
            low, high = parameter.low, parameter.high
        found[name] = low, high, parameter.baseline
    return found


def tuned(given: Any) -> dict[str, Any]:
    """The parameters by what a file says, as many nodes read it: what is no number is left out.

    The default then stands, and a number beyond the limits becomes the limit, without a word.
    ROS reads 1e3 as a string, and only 1.0e3 as a number.
    """
    values = {}
    for name, (low, high, default) in limits().items():
        value = given.get(name) if isinstance(given, dict) else None
        if isinstance(value, bool) or not isinstance(value, int | float):
            value = default
        value = min(max(value, low), high)
        whole = isinstance(KeyframeGicp.space.parameters[name], Integer)
        values[name] = int(value) if whole else float(value)
    return values


def check_layout(message: Any, wanted: list[str] | None) -> None:
    """Die, as systems do that know one layout of points, where a cloud has other fields."""
    names = [field.name for field in message.fields]
    if wanted and names != wanted:
        sys.stderr.write(f"gicp: the fields are {names}, not {wanted}\n")
        sys.stderr.flush()
        os._exit(1)


def to_scan(message: Any, stamp: int) -> Scan:
    """The finite points of a sensor_msgs/PointCloud2 whose x, y and z are float32."""
    order = ">" if message.is_bigendian else "<"
    offsets = {field.name: field.offset for field in message.fields if field.datatype == _FLOAT32}
    kind = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [f"{order}f4"] * 3,
            "offsets": [offsets[axis] for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.row_step)
    used = rows[:, : message.width * message.point_step]
    raw = np.ascontiguousarray(used).view(kind).reshape(-1)
    points = np.stack([raw[axis] for axis in "xyz"], axis=1).astype(np.float32)
    return Scan(stamp, points[np.isfinite(points).all(axis=1)])


class LidarOdometry:
    """Keyframe GICP from the first scan on, with a frame of its own for poses."""

    def __init__(self, parameters: dict[str, Any], frame: Any = "lidar"):
        self._odometry = KeyframeGicp(parameters)
        self._R_frame_lidar = FRAMES.get(frame, FRAMES["lidar"])
        self._started = False

    def configure(self, parameters: dict[str, Any]) -> None:
        """Change parameters before the next scan."""
        self._odometry.configure(parameters)

    def register(self, scan: Scan) -> Any:
        """The pose at a scan, of shape (4, 4)."""
        prepared = self._odometry.prepare(scan)
        T = np.eye(4)
        if self._started:
            T = np.array(self._odometry.register(prepared).T_odom_sensor)
        else:
            self._odometry.start(prepared, np.eye(4))
            self._started = True
        R = self._R_frame_lidar
        T[:3, :3], T[:3, 3] = R @ T[:3, :3] @ R.T, R @ T[:3, 3]
        return T


def quaternion(T: Any) -> list[float]:
    """The rotation of a pose as x, y, z, w."""
    return to_quaternions(T[None])[0].tolist() if np.isfinite(T).all() else [np.nan] * 4
