"""What recordings consist of: scans, measurements of an IMU, and the formats that give them."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator

from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.trajectory import Trajectory

# Measurements of an IMU.


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


# What every sequence offers.


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

    def backward(self) -> Iterator[Scan]:
        """Read the scans, the last one first."""

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR, if they are known."""

    def imu(self) -> Imu | None:
        """Measurements of the IMU, if there is one."""

    def played_at(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Nanoseconds at which measurements of `stamps` arrive when played in real time."""


# When a scan began, and when each of its points was measured.


TIME_FIELDS = ("time", "t", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
"""Names under which drivers write the time of a point."""

Unit = Literal["s", "ms", "us", "ns"]
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

# A turn of a spinning LiDAR takes 0.05 to 0.2 s, a frame of the slowest accumulating ones 1 s.
_LONGEST = 10.0
# A header and its points are on the same clock if they are no further apart than this.
_SAME_CLOCK = 10.0


class TimingError(AdaptuneError):
    """Times of points that are not plausible."""


@dataclass(frozen=True)
class Timing:
    """Meaning of the time stamps of a recording."""

    # Moment of the scan that the header's stamp marks. `auto` follows the points: they come before
    # the stamp or after it. Scans whose points have no time are stamped at their start.
    stamp: Literal["auto", "start", "end"] = "auto"
    # Unit of the points' times. If left out, floating-point numbers are seconds and whole ones
    # nanoseconds; the size of absolute times reveals their unit.
    unit: Unit | None = None
    # Seconds a scan takes; only for scans stamped at their end whose points have no time.
    period: float = 0.1

    def resolve(
        self, stamp: int, values: NDArray[Any] | None, extent: tuple[float, float]
    ) -> tuple[int, NDArray[np.float32] | None]:
        """Find the start of a scan, and the time of each point since then.

        Parameters
        ----------
        stamp
            The header's, in nanoseconds.
        values
            Times of the valid points as the driver wrote them, of shape (n,): relative to the
            stamp, or absolute. All finite.
        extent
            The least and the greatest of them.

        Returns
        -------
        start : int
            Nanoseconds.
        times : ndarray of shape (n,)
            float32 seconds since `start`, none below zero.
        """
        if values is None or not len(values):
            start = stamp - round(self.period * 1e9) if self.stamp == "end" else stamp
            return start, None if values is None else np.empty(0, np.float32)
        low, high = extent
        scale, absolute = self._scale(values.dtype, high)
        span = (high - low) * scale
        what = ""
        if not span <= _LONGEST:
            what = f"span {span:g} s"
        elif not absolute and max(abs(low), abs(high)) * scale > _LONGEST:
            what = f"reach {high * scale:g} s from the scan's stamp"
        if what:
            help_ = "if they are in another unit, name it with `time_unit: s|ms|us|ns`"
            raise TimingError(f"the times of the points {what}; {help_}")
        zero, begin = self._start(stamp, extent, scale, absolute)
        if scale == 1.0 and zero == 0 and values.dtype == np.float32:
            times = np.ascontiguousarray(values)
        else:
            # The difference of small integers is not always one of them.
            small = values.dtype.kind in "iu" and values.dtype.itemsize < 8
            wide = values.astype(np.int64) if small else values
            times = ((wide - wide.dtype.type(zero)) * scale).astype(np.float32)
        return stamp + round(begin * 1e9), times

    def _start(
        self, stamp: int, extent: tuple[float, float], scale: float, absolute: bool
    ) -> tuple[float, float]:
        """The points' time at the scan's start, and seconds from the header's stamp to it."""
        low, high = extent
        span = (high - low) * scale
        if absolute:
            nanoseconds = low if scale == 1e-9 else low * scale * 1e9
            before = (int(nanoseconds) - stamp) * 1e-9
            same_clock = abs(before) <= _SAME_CLOCK
            known = {"start": 0.0, "end": -span}
            return low, known.get(self.stamp, before if same_clock else 0.0)
        if low < 0:
            known = {"start": 0.0, "end": (low - max(high, 0)) * scale}
            return low, known.get(self.stamp, low * scale)
        # Counted from the scan's start, which is before the first ray that came back.
        return 0, -high * scale if self.stamp == "end" else 0.0

    def _scale(self, dtype: np.dtype[Any], high: float) -> tuple[float, bool]:
        """Seconds per unit, and whether the times are absolute."""
        if self.unit is not None:
            scale = _SECONDS[self.unit]
            return scale, high * scale > 1e6 and dtype.itemsize == 8
        whole = dtype.kind in "iu"
        if dtype.itemsize < 8 or high < (1e12 if whole else 1e6):
            return (1e-9 if whole else 1.0), False
        # Seconds since 1970 are about 2e9: what is larger by 1e3 is in milliseconds, and so on.
        for scale, limit in ((1.0, 1e11), (1e-3, 1e14), (1e-6, 1e17)):
            if high < limit:
                return scale, True
        return 1e-9, True


AUTO = Timing()
"""Follow the points."""


# Names of views of sequences.


OF_VIEW = "+"
"""Joins the name of a sequence and the name of a view of it. No name of a user contains it."""


def origin(name: str) -> str:
    """Name of the sequence that a training sequence is, or is a view of."""
    return name.partition(OF_VIEW)[0]


def places(names: Sequence[str]) -> NDArray[np.intp]:
    """Number the places of sequences, of shape (n,): a view has the place of its origin."""
    number = {place: i for i, place in enumerate(dict.fromkeys(map(origin, names)))}
    return np.array([number[origin(name)] for name in names], np.intp)


def stretch_numbers(place: NDArray[np.intp], stretch: NDArray[np.intp]) -> NDArray[np.intp]:
    """Number stretches of all places from 0 on, of shape (n_frames,).

    Parameters
    ----------
    place
        Number of each frame's place, of shape (n_frames,).
    stretch
        Number of its stretch there, of shape (n_frames,).
    """
    _, number = np.unique(np.stack([place, stretch], axis=1), axis=0, return_inverse=True)
    return np.asarray(number.ravel())


# Parts of a sequence, in percent of its duration.


Fractions = tuple[float, float]
"""Where a part begins and ends, as fractions of the duration."""

_PERCENT = re.compile(r"\s*(\d+(?:\.\d+)?)\s*-\s*(\d+(?:\.\d+)?)\s*%\s*")


def read_part(given: Any) -> Fractions:
    """Read ``0-60%``, or two fractions; a ValueError says what is wrong."""
    begin, end = 1.0, 0.0
    if isinstance(given, str) and (match := _PERCENT.fullmatch(given)):
        begin, end = (float(percent) / 100.0 for percent in match.groups())
    elif isinstance(given, list | tuple) and [type(f) for f in given] in ([float] * 2, [int] * 2):
        begin, end = map(float, given)
    if not 0.0 <= begin < end <= 1.0:
        raise ValueError("give a part in percent of the duration, from 0 to 100, as in 0-60%")
    return begin, end


def part_name(name: str, part: Fractions) -> str:
    """Name of a part of a sequence, which may be the name of a file."""
    begin, end = (f"{100.0 * fraction:.10g}" for fraction in part)
    return f"{name}_{begin}-{end}"


Part = Annotated[Fractions, BeforeValidator(read_part)]


class Frame(NamedTuple):
    """A scan before it is decoded."""

    stamp: int  # nanoseconds, as recorded
    recorded: int  # nanoseconds on the clock of the recorder; the stamp where there is none
    load: Callable[[], Scan]  # decodes the scan


class Source(Protocol):
    """One format of recordings.

    Attributes
    ----------
    random_access : bool
        Whether frames hold nothing in memory before they are loaded.
    """

    random_access: ClassVar[bool]

    @property
    def name(self) -> str:
        """Its file, for messages."""

    @property
    def n_messages(self) -> int:
        """At least as many as there are scans."""

    @property
    def begins(self) -> Mapping[str, int]:
        """Stamps of the first message on the topics of scans and poses, if it has topics."""

    @property
    def files(self) -> Sequence[Path]:
        """All files that its scans and its IMU are read from."""

    @property
    def pose_files(self) -> Sequence[Path]:
        """All other files that its own poses are read from."""

    def frames(self) -> Iterator[Frame]:
        """All scans in the order of their recording."""

    def about(self) -> dict[str, Any]:
        """Plain data to store with its decoded scans."""

    def span(self) -> tuple[int, int] | None:
        """First stamp, and about the last one; none where there is no scan."""

    def poses(self, name: str | None, child_frame: str | None, /) -> Trajectory | None:
        """Reference poses of the recording itself, or, of a bag, those of one topic."""

    def imu(self, name: str | None, /) -> Imu | None:
        """Measurements of its IMU, in the IMU's own units."""
