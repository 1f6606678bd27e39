"""RKO-LIO, through the bindings of its Python package.

Its own Python class converts stamps one numpy scalar at a time, so the bindings beneath it are
called: hence the pinned version.
"""

import contextlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adaptune.errors import OdometryError, import_extra
from adaptune.geometry import Poses, count_within
from adaptune.odometry.base import MIN_POINTS, Description, RangeSettings
from adaptune.odometry.own_frame import END, MIDDLE, NO_IMU, OwnFrameOdometry
from adaptune.recording.scan import Imu, Scan
from adaptune.space import Float, ParameterSet, ParameterSpace

_LATER = 10**9  # nanoseconds added to all stamps: at time 0 it assumes that nothing has come yet


class RkoLioSettings(RangeSettings):
    """Settings of RKO-LIO."""

    # Register fewer points than the map receives; sparse LiDARs may do better without.
    double_downsample: bool = True


class RkoLioScan(NamedTuple):
    """A scan in its types: float64 points, and nanoseconds of all, of the first, to the last."""

    points: NDArray[np.float64]
    stamps: list[int]
    stamp: int
    duration: int
    usable: bool
    imu: Imu

    @property
    def nbytes(self) -> int:
        """Memory, in bytes; a whole number takes 32 and its place in the list 8."""
        return 256 + self.points.nbytes + 40 * len(self.stamps) + self.imu.nbytes


def _bindings() -> Any:
    return import_extra("rko-lio", "rko_lio.rko_lio_pybind")[0]


with contextlib.suppress(OdometryError):
    # Processes that are forked from one with this module find it loaded.
    _bindings()


class RkoLio(OwnFrameOdometry):
    """RKO-LIO (Malladi et al., RA-L 2026).

    It reads its parameters when it begins, and begins at rest. It assumes that its first frame is
    level: the adapter turns that frame so that the mean of the first accelerations points up.
    """

    space = ParameterSpace.of(
        voxel_size=Float(low=0.1, high=3.0, baseline=1.0, log=True, unit="m"),
        max_correspondence_distance=Float(low=0.1, high=3.0, baseline=0.5, log=True, unit="m"),
        max_expected_jerk=Float(low=0.3, high=30.0, baseline=3.0, log=True, unit="m/s^3"),
        min_beta=Float(low=10.0, high=5000.0, baseline=200.0, log=True),
    )
    settings_type = RkoLioSettings
    needs_imu = True

    @classmethod
    def describe(cls, settings: Any) -> Description:
        _bindings()  # raises if there are none
        return super().describe(settings)

    def _values(self, deskew: bool) -> ParameterSet:
        """Values that may differ from RKO-LIO's defaults."""
        return {
            **{name: float(value) for name, value in self.parameters.items()},
            "min_range": self.settings.min_range,
            "max_range": self.settings.max_range,
            "double_downsample": self.settings.double_downsample,
            "deskew": deskew,
            "max_num_threads": 1,
        }

    def prepare(self, scan: Scan) -> RkoLioScan:
        if scan.imu is None:
            raise OdometryError(NO_IMU.format("rko_lio"))
        points = scan.points.astype(np.float64)
        n_in_range = count_within(points, self.settings.min_range, self.settings.max_range)
        stamps = np.full(len(scan), scan.stamp + _LATER, np.int64)
        if scan.times is not None:
            stamps += (scan.times.astype(np.float64) * 1e9).astype(np.int64)
        stamp, duration = scan.stamp + _LATER, 0
        if len(scan):
            stamp, duration = int(stamps.min()), int(np.ptp(stamps))
        usable = n_in_range >= MIN_POINTS
        return RkoLioScan(points, stamps.tolist(), stamp, duration, usable, scan.imu)

    def _begin(self, prepared: RkoLioScan) -> None:
        bindings = _bindings()
        config = bindings._LIOConfig()
        for name, value in self._values(self.settings.deskew and prepared.duration > 0).items():
            setattr(config, name, value)
        self._share = END if config.deskew else MIDDLE
        self._lio = bindings._LIO(config)
        T_sensor_imu = prepared.imu.T_sensor_imu
        self._T_base_sensor = np.eye(4)
        if len(prepared.imu):
            up = T_sensor_imu[:3, :3] @ prepared.imu.acceleration.mean(axis=0)
            self._T_base_sensor[:3, :3] = _levelling(up)
        self._T_base_imu = self._T_base_sensor @ T_sensor_imu
        self._early: Sequence[tuple[int, Any, Any]] = ()

    def _process(self, prepared: RkoLioScan) -> Poses | None:
        imu = prepared.imu
        stamps = (imu.stamps + _LATER).tolist()
        new = zip(stamps, imu.acceleration, imu.angular_velocity, strict=True)
        measured = [*self._early, *new]
        # A measurement after the scan's end belongs to the motion to the next one.
        end = prepared.stamp + prepared.duration
        self._early = [m for m in measured if m[0] >= end]
        for stamp, acceleration, gyro in measured[: len(measured) - len(self._early)]:
            self._lio.add_imu_measurement(self._T_base_imu, acceleration, gyro, stamp)
        if not prepared.usable:
            return None
        bindings = _bindings()
        points, times = bindings._Vector3sVector(prepared.points), prepared.stamps
        scan = points, bindings._VectorInt64(times), prepared.stamp, end
        try:
            self._lio.register_scan(self._T_base_sensor, *scan)
        except (bindings.InputError, bindings.RegistrationError):
            return None
        return np.asarray(self._lio.pose() @ self._T_base_sensor)


def _levelling(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The smallest rotation that takes a direction of shape (3,) to +z."""
    if not np.linalg.norm(up) > 0:
        return np.eye(3)
    return np.asarray(Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix())
