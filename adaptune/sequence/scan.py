"""One turn of a LiDAR."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.sequence.imu import Imu


@dataclass(frozen=True, eq=False)
class Scan:
    """A point cloud in the sensor's frame; its arrays cannot be written to.

    Attributes
    ----------
    stamp : int
        Nanoseconds, at the scan's start.
    points : ndarray of shape (n, 3)
        float32 metres, finite. There may be none.
    times : ndarray of shape (n,), optional
        float32 seconds since `stamp` at which each point was measured.
    rings : ndarray of shape (n,), optional
        uint16 number of the laser that measured each point.
    imu : Imu, optional
        What the IMU measured since the scan before, to the first measurement at the scan's end or
        after it.
    intensities : ndarray of shape (n,), optional
        float32 share of the light that came back from each point, on the sensor's own scale;
        finite.
    """

    stamp: int
    points: NDArray[np.float32]
    times: NDArray[np.float32] | None = None
    rings: NDArray[np.uint16] | None = None
    imu: Imu | None = None
    intensities: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        # Decoded scans may be shared by all who use them, as those from the cache are.
        for array in (self.points, self.times, self.rings, self.intensities):
            if array is not None:
                array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.points)

    def select(self, which: NDArray[Any]) -> "Scan":
        """The scan with some of its points, by a mask of shape (n,) or indices of shape (m,)."""
        index = np.flatnonzero(which) if which.dtype == np.bool_ else which
        return Scan(
            self.stamp,
            self.points.take(index, axis=0),
            None if self.times is None else self.times.take(index),
            None if self.rings is None else self.rings.take(index),
            self.imu,
            None if self.intensities is None else self.intensities.take(index),
        )

    @property
    def span(self) -> int:
        """Nanoseconds from the stamp to the last point; 0 where points have no times."""
        return round(float(self.times.max()) * 1e9) if self.times is not None and len(self) else 0
