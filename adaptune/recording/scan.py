"""What recordings consist of: scans, measurements of an IMU, and the formats that give them."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.trajectory import Trajectory

_MEASURED = ("stamps", "angular_velocity", "acceleration")


class ImuNoise(NamedTuple):
    """White noise and random walk of the biases of an IMU; by default those of a fair MEMS IMU."""

    gyroscope: float = 2e-4  # rad/s for a root hertz
    accelerometer: float = 2e-3  # m/s^2 for a root hertz
    gyroscope_walk: float = 2e-5  # rad/s^2 for a root hertz
    accelerometer_walk: float = 2e-4  # m/s^3 for a root hertz


USUAL = ImuNoise()


@dataclass(frozen=True, eq=False)
class Imu:
    """What an IMU measured, in its own frame.

    Attributes
    ----------
    stamps : ndarray of shape (n,)
        Strictly increasing integer nanoseconds.
    angular_velocity : ndarray of shape (n, 3)
        Radians per second.
    acceleration : ndarray of shape (n, 3)
        Metres per second squared, gravity included.
    T_sensor_imu : ndarray of shape (4, 4)
        The IMU's pose in the LiDAR's frame.
    noise : ImuNoise
    """

    stamps: NDArray[np.int64]
    angular_velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    T_sensor_imu: Poses = field(default_factory=lambda: np.eye(4))
    noise: ImuNoise = USUAL

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def nbytes(self) -> int:
        """Memory that the measurements take, in bytes."""
        return self.stamps.nbytes + self.angular_velocity.nbytes + self.acceleration.nbytes

    def part(self, first: int, last: int) -> "Imu":
        """Measurements from number `first` to before number `last`."""
        return replace(self, **{name: getattr(self, name)[first:last] for name in _MEASURED})


def joined(parts: Sequence[Imu]) -> Imu:
    """Measurements of one IMU, one part after the other."""
    whole: dict[str, Any]
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _MEASURED}
    return replace(parts[0], **whole)


class Reading(NamedTuple):
    """How a scan was read from its message; times in seconds since its stamp, NaN without times."""

    stamp: int = 0  # of the scan
    first: float = np.nan
    last: float = np.nan
    unit: float = 0.0  # seconds per unit of the points' times
    clock: int | None = None  # nanoseconds of the first point, if the sensor gives its own clock
    unread: str = ""  # a field whose name says that it holds times, and whose values do not
    marks: float = 0.0  # share of the points that mark rays that did not come back, far away
    wrapped: float = 0.0  # seconds that the times span as stored, where some wrapped below zero


UNREAD = Reading()


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
    reading : Reading
        Of a scan as it was read, neither changed nor from the cache.
    """

    stamp: int
    points: NDArray[np.float32]
    times: NDArray[np.float32] | None = None
    rings: NDArray[np.uint16] | None = None
    imu: Imu | None = None
    intensities: NDArray[np.float32] | None = None
    reading: Reading = UNREAD

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


class SequenceError(AdaptuneError):
    """A recording that cannot be read as described."""


class Recording(Protocol):
    """Scans of a LiDAR in the order of their stamps, with its reference and its IMU."""

    @property
    def name(self) -> str:
        """Its file, for messages."""

    @property
    def n_messages(self) -> int:
        """About how many scans there are."""

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans; their stamps strictly increase."""

    def since(self, stamp: int) -> Iterator[Scan]:
        """Read the scans from a little before `stamp` on."""

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR, if they are known."""

    def imu(self) -> Imu | None:
        """Measurements of the IMU, if there is one."""


def segment_numbers(place: NDArray[np.intp], segment: NDArray[np.intp]) -> NDArray[np.intp]:
    """Number segments of all recordings from 0 on, by place and segment of each frame: (n,)."""
    _, number = np.unique(np.stack([place, segment], axis=1), axis=0, return_inverse=True)
    return np.asarray(number.ravel())


def read_ahead(scans: Iterable[Scan], n: int) -> Iterator[Scan]:
    """Read so many scans ahead in a thread; an error is raised here."""
    source, pool = iter(scans), ThreadPoolExecutor(1)
    read = deque(pool.submit(next, source, None) for _ in range(n))
    try:
        while (scan := read.popleft().result()) is not None:
            read.append(pool.submit(next, source, None))
            yield scan
    finally:
        _ = [one.cancel() for one in read]
        # Where it was opened: SQLite lets no other thread close a bag.
        pool.submit(getattr(source, "close", lambda: None))
        pool.shutdown(wait=False)


class Frame(NamedTuple):
    """A scan before it is decoded."""

    stamp: int  # nanoseconds, as recorded
    recorded: int  # nanoseconds on the clock of the recorder; the stamp where there is none
    load: Callable[[], Scan]  # decodes the scan


BACKWARD = "scans whose stamps do not come after the one before"
LEAP = "scans whose stamps leap ahead of the recording"


def in_order(frames: Iterable[Frame], left_out: Counter[str]) -> Iterator[Frame]:
    """Leave out the fewest frames so that stamps strictly increase.

    Of two that do not, the one that disagrees more with the recorder's clock is left out: a single
    stamp in the future costs one scan, not all that follow.
    """
    last: Frame | None = None
    doubtful: Frame | None = None
    for frame in frames:
        if doubtful is not None:
            if frame.stamp > doubtful.stamp:
                yield doubtful
                last = doubtful
            elif _leap(last, doubtful) > _leap(last, frame):
                left_out[LEAP] += 1
            else:
                left_out[BACKWARD] += 1
                continue
            doubtful = None
        if last is not None and frame.stamp <= last.stamp:
            left_out[BACKWARD] += 1
        elif last is None or _leap(last, frame) > _DOUBT:
            # The next frame decides. Other frames pass at once: they are decoded while their bytes
            # are still in the processor's cache.
            doubtful = frame
        else:
            yield frame
            last = frame
    if doubtful is not None:
        yield doubtful


_DOUBT = 50_000_000  # nanoseconds; a recorder is seldom later than this


def _leap(last: Frame | None, frame: Frame) -> int:
    """By how much a stamp has moved against the recorder's clock."""
    usual = 0 if last is None else last.stamp - last.recorded
    return abs(frame.stamp - frame.recorded - usual)
