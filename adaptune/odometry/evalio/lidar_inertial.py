"""The pipelines of evalio that need a LiDAR and an IMU."""

from collections import deque
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adaptune.geometry import Poses
from adaptune.odometry.evalio.base import Pipeline, RingedPipeline
from adaptune.odometry.evalio.point_layout import EvalioScan
from adaptune.odometry.scan_time import MIDDLE
from adaptune.sequence.imu import Imu
from adaptune.sequence.scan import Scan
from adaptune.space import Float, Integer, ParameterSet, ParameterSpace

_BEHIND = 2
"""Scans that LIO-SAM waits for before it registers one."""

_SMOOTH = 3
"""Scans over which the mean velocity is taken that carries its poses on."""


class LioSam(RingedPipeline):
    """LIO-SAM (Shan et al., IROS 2020), in the version of E. Potokar, without loop closure.

    It is always two scans behind. The gyroscope's rotation and the mean velocity of the last scans
    carry its pose on to the present scan.
    """

    pipeline = "liosam"
    needs_imu = True
    untuned: ClassVar[ParameterSet] = {"numberOfCores": 1, "mappingProcessInterval": 0.0}
    space = ParameterSpace.of(
        edgeThreshold=Float(low=0.1, high=10.0, baseline=1.0, log=True),
        surfThreshold=Float(low=0.01, high=1.0, baseline=0.1, log=True),
        odometrySurfLeafSize=Float(low=0.1, high=1.5, baseline=0.4, log=True, unit="m"),
        mappingCornerLeafSize=Float(low=0.05, high=1.0, baseline=0.2, log=True, unit="m"),
        mappingSurfLeafSize=Float(low=0.1, high=1.5, baseline=0.4, log=True, unit="m"),
        surroundingkeyframeAddingDistThreshold=Float(
            low=0.2, high=5.0, baseline=1.0, log=True, unit="m"
        ),
        surroundingKeyframeSearchRadius=Float(
            low=10.0, high=100.0, baseline=50.0, log=True, unit="m"
        ),
    )

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        points, shape = super()._layout(scan)
        if len(scan) and scan.times is not None:
            # It takes the last point's time for the scan's end.
            points = np.concatenate([points, points[[int(scan.times.argmax())]]])
        return points, shape

    def _begin(self, prepared: EvalioScan) -> None:
        self._scans: deque[EvalioScan] = deque(maxlen=_BEHIND + 1)
        self._own: deque[tuple[int, Poses]] = deque(maxlen=_SMOOTH + 1)
        super()._begin(prepared)

    def _estimate(self, prepared: EvalioScan) -> Poses | None:
        T_own_then = super()._estimate(prepared)
        self._scans.append(prepared)
        if T_own_then is None or len(self._scans) <= _BEHIND:
            return None
        then = self._scans[0].stamp
        if not self._own:
            self._own.append((then, T_own_then))
            return T_own_then @ self._T_previous_current @ self._T_previous_current
        if np.array_equal(self._own[-1][1], T_own_then):
            # It waits for measurements.
            return None
        self._own.append((then, T_own_then))
        before, T_own_before = self._own[0]
        velocity = (T_own_then[:3, 3] - T_own_before[:3, 3]) / (then - before)
        T_own_sensor = T_own_then.copy()
        T_own_sensor[:3, 3] += velocity * (prepared.stamp - then)
        T_own_sensor[:3, :3] @= _turned([s.imu for s in self._scans if s.imu], then, prepared.stamp)
        return T_own_sensor


def _turned(measured: list[Imu], start: int, stop: int) -> NDArray[np.float64]:
    """Rotation of the LiDAR from one stamp to another, by the gyroscope's mean rate."""
    stamps = np.concatenate([imu.stamps for imu in measured])
    rates = np.concatenate([imu.angular_velocity for imu in measured])
    rates = rates[(stamps > start) & (stamps <= stop)]
    if not len(rates):
        return np.eye(3)
    turn = measured[0].T_sensor_imu[:3, :3] @ rates.mean(axis=0) * (stop - start) * 1e-9
    return np.asarray(Rotation.from_rotvec(turn).as_matrix())


class Dlio(Pipeline):
    """DLIO (Chen et al., ICRA 2023).

    It learns which way is down from its first measurements, and assumes small biases. Its own
    rules of adaptation (`adaptive_params`) are off: adaptune tunes those parameters. It deskews to
    the median time of a scan's points.
    """

    pipeline = "dlio"
    deskews_to = MIDDLE
    needs_imu = True
    untuned: ClassVar[ParameterSet] = {
        "adaptive_params": False,
        # By default it needs to stand still for 3 s, and gives no pose before.
        "imu_calib_time": 0.05,
        "calibrate_gyro": False,
        "calibrate_accel": False,
    }
    space = ParameterSpace.of(
        vf_res=Float(low=0.1, high=1.0, baseline=0.25, log=True, unit="m"),
        gicp_max_corr_dist=Float(low=0.2, high=3.0, baseline=0.5, log=True, unit="m"),
        gicp_max_iter=Integer(low=3, high=32, baseline=32, log=True),
        gicp_k_correspondences=Integer(low=8, high=32, baseline=16, log=True),
        keyframe_thresh_dist=Float(low=0.3, high=10.0, baseline=1.0, log=True, unit="m"),
        submap_knn=Integer(low=2, high=30, baseline=10, log=True),
        geo_Kp=Float(low=1.0, high=10.0, baseline=4.5, log=True),
        geo_Kv=Float(low=2.0, high=25.0, baseline=11.25, log=True),
        geo_Kq=Float(low=1.0, high=10.0, baseline=4.0, log=True),
    )
