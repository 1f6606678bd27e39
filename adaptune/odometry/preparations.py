"""Prepared scans that several instances share."""

from collections.abc import Hashable
from typing import Any

from adaptune.odometry.base import OdometryInstance
from adaptune.sequence.scan import Scan


class Preparations:
    """Prepares scans for several instances, once for all with the same preparation.

    The first instance with each preparation prepares for all of them: they share what it learned
    from the first scan's layout.
    """

    def __init__(self) -> None:
        self._first: dict[Hashable, OdometryInstance] = {}

    def of(self, scan: Scan) -> "PreparedScan":
        """A scan that is prepared for whoever asks."""
        return PreparedScan(scan, self)

    def prepare(self, scan: Scan, instance: OdometryInstance) -> tuple[Hashable, Any]:
        """Prepare a scan for an instance; what it was prepared by, and the result."""
        key = instance.preparation
        return key, self._first.setdefault(key, instance).prepare(scan)


class PreparedScan:
    """A scan with what it was prepared to.

    Attributes
    ----------
    scan : Scan
    """

    def __init__(self, scan: Scan, preparations: Preparations):
        self.scan = scan
        self._preparations = preparations
        self._prepared: dict[Hashable, Any] = {}

    @property
    def stamp(self) -> int:
        """Nanoseconds."""
        return self.scan.stamp

    def by(self, instance: OdometryInstance) -> Any:
        """The scan as an instance takes it; it is prepared where nobody has asked before."""
        if (key := instance.preparation) not in self._prepared:
            self._prepared |= [self._preparations.prepare(self.scan, instance)]
        return self._prepared[key]

    def with_scan(self, scan: Scan) -> "PreparedScan":
        """Another scan, which the same instances prepare."""
        return PreparedScan(scan, self._preparations)
