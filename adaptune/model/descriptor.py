"""Descriptors by name, one or several of them."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune._system import processes
from adaptune._system.strict import Plugins
from adaptune.errors import AdaptuneError
from adaptune.odometry import wire
from adaptune.odometry.content import python_content
from adaptune.recording.scan import Scan

Descriptor = Callable[[Scan], NDArray[np.floating]]
"""Describes any scan, even an empty one, by the same number of finite numbers."""

ENTRY_POINTS = "adaptune.descriptors"
"""Group in which other packages announce their descriptors, each by its name."""

DESCRIPTORS = {"ndt": "adaptune.model.ndt:describe"}


class DescriptorError(AdaptuneError):
    """A descriptor that does not exist or does not describe a scan."""


_SERVICE = "adaptune.model.descriptor"
_SECONDS = 60.0
"""A descriptor of the user may take so long for a scan."""


FUNCTIONS = Plugins("descriptor", DESCRIPTORS, DescriptorError, ENTRY_POINTS, "function")


def descriptor(name: str) -> Descriptor:
    """Function of a descriptor; a DescriptorError if there is none."""
    found = FUNCTIONS.load(name)
    if not callable(found):
        raise DescriptorError(f"{name}: is not a function from a scan to an array")
    describe: Descriptor = found
    return describe


def check_descriptor(name: str) -> None:
    """Refuse a name that leads to no descriptor; the user's are imported elsewhere."""
    path = FUNCTIONS.where(name)
    if name not in DESCRIPTORS:
        try:
            processes.server(_SERVICE, path)
        except processes.HostError as error:
            raise DescriptorError(str(error)) from error


def descriptor_content(names: Iterable[str]) -> dict[str, str]:
    """What the descriptors of these names depend on; nothing for those of adaptune."""
    own = (name for name in names if name not in DESCRIPTORS)
    return {k: v for name in own for k, v in python_content(name, ENTRY_POINTS).items()}


# What runs in a process of its own for a descriptor of the user, see `adaptune._system.processes`.


def load(name: str) -> None:
    """Import a descriptor."""
    descriptor(name)


def answers(name: str) -> processes.Answer:
    """Describe scan after scan."""
    describe = descriptor(name)
    return lambda message: {"described": np.asarray(describe(wire.to_scan(message)), np.float32)}


def _hosted(name: str) -> Descriptor:
    """Function of a descriptor of the user that runs in a process of its own."""
    bounds = processes.Bounds(_SECONDS, late=f"a scan took longer than {_SECONDS:g} s")
    process = processes.Conversation(
        processes.Forked(_SERVICE, FUNCTIONS.where(name), "answers", bounds)
    )

    def describe(scan: Scan) -> NDArray[np.float32]:
        try:
            header = {"type": "describe", "stamp": scan.stamp}
            return process.ask(header, **wire.scan_arrays(scan)).arrays["described"]
        except processes.HostError as error:
            raise DescriptorError(f"{error}; this was scan {scan.stamp}") from error

    return describe


class Describer:
    """Describes scans by one or several descriptors, of these names (see `descriptor`).

    `blocks` says by name, in order, how many numbers each descriptor has.
    """

    def __init__(self, names: Iterable[str]):
        self._functions = {
            name: descriptor(name) if name in DESCRIPTORS else _hosted(name) for name in names
        }
        self.blocks: dict[str, int] = {}
        # This also loads compiled code before the first scan.
        nothing = Scan(0, np.empty((0, 3), np.float32))
        self.blocks = {name: len(self._describe(name, nothing)) for name in self._functions}

    def __call__(self, scan: Scan) -> NDArray[np.float32]:
        """The descriptors one after the other, of shape (n_features,).

        A DescriptorError names one that is not finite or has another shape than for other scans.
        """
        return np.concatenate([self._describe(name, scan) for name in self._functions])

    def _describe(self, name: str, scan: Scan) -> NDArray[np.float32]:
        found = np.asarray(self._functions[name](scan), np.float32)
        if found.ndim != 1 or len(found) != self.blocks.get(name, len(found)):
            want = f"({self.blocks[name]},)" if name in self.blocks else "one axis"
            what = f"by an array of shape {found.shape}, instead of {want}"
            raise DescriptorError(f"{name}: described scan {scan.stamp} {what}")
        if not np.isfinite(found).all():
            raise DescriptorError(f"{name}: described scan {scan.stamp} by NaN or infinity")
        return found


def lowest_elevation(scan: Scan) -> float:
    """Elevation in degrees below which one point in a hundred lies; NaN for an empty scan.

    The lowest beam ends on the ground almost everywhere. Its elevation thus identifies the sensor
    and its mount, not the place.
    """
    if not len(scan):
        return math.nan
    x, y, z = scan.points[:: max(1, len(scan) // 2000)].T
    return math.degrees(math.atan(np.quantile(z / np.maximum(np.hypot(x, y), 1e-3), 0.01)))


def averaged(
    descriptors: NDArray[np.float32], stamps: NDArray[np.int64], n: int, period: float
) -> NDArray[np.float32]:
    """Mean of each frame's descriptor and of those one period before, two before, and so on.

    A selector that describes one scan each period and remembers the last `n` has the same mean. It
    is of fewer near the sequence's start. Descriptors and means are of shape (n_frames,
    n_features), stamps are rising nanoseconds, and the period is in seconds.
    """
    total = descriptors.astype(np.float64)
    number = np.ones(len(stamps))
    for k in range(1, n):
        before = np.searchsorted(stamps, stamps - round(k * period * 1e9), side="right") - 1
        there = before >= 0
        total[there] += descriptors[before[there]]
        number += there
    return (total / number[:, None]).astype(np.float32)


def compact(descriptors: NDArray[np.float32]) -> NDArray[Any]:
    """Descriptors for a file. Counts become whole numbers, which take less room."""
    with np.errstate(invalid="ignore"):
        counts = descriptors.astype(np.uint16)
    return counts if (counts == descriptors).all() else descriptors
