"""What every sequence offers."""

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.sequence.imu import Imu
from adaptune.sequence.scan import Scan
from adaptune.trajectory import Trajectory


class SequenceError(AdaptuneError):
    """A recording that cannot be read as described."""


class Sequence(Protocol):
    """Scans of a LiDAR in the order of their stamps, with its reference and its IMU."""

    @property
    def name(self) -> str:
        """Its file, for messages."""

    @property
    def n_messages(self) -> int:
        """About how many scans there are."""

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans; their stamps strictly increase."""

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR, if they are known."""

    def imu(self) -> Imu | None:
        """Measurements of the IMU, if there is one."""

    def played_at(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Nanoseconds at which measurements of `stamps` arrive when played in real time."""
