"""Prepared scans that several instances share."""

import sys
from collections.abc import Hashable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from adaptune.odometry.base import OdometryInstance
from adaptune.recording.scan import Scan


class PreparedScan:
    """A scan that is prepared for several instances, once for all with the same preparation.

    `first` is shared by the scans: the first instance with each preparation, which prepares for all
    of them. They share what it learned from the first scan's layout.
    """

    def __init__(self, scan: Scan, first: dict[Hashable, Any]):
        self.scan, self._first = scan, first
        self.stamp = scan.stamp
        self._prepared: dict[Hashable, Any] = {}

    def by(self, instance: OdometryInstance) -> Any:
        """The scan as an instance takes it; it is prepared where nobody has asked before."""
        if (key := instance.preparation) not in self._prepared:
            first = self._first.setdefault(key, instance)
            self._prepared[key] = first.prepare(self.scan)
        return self._prepared[key]


def prepared_bytes(prepared: Any) -> int:
    """Memory of a prepared scan, roughly, in bytes; a compiled object counts a megabyte."""
    if (size := getattr(prepared, "nbytes", None)) is not None:
        return int(size)
    if is_dataclass(prepared):
        prepared = [getattr(prepared, each.name) for each in fields(prepared)]
    if isinstance(prepared, Mapping):
        prepared = [*prepared.values()]
    if isinstance(prepared, tuple | list):
        return sum(map(prepared_bytes, prepared))
    plain = prepared is None or isinstance(prepared, int | float | str | bytes)
    return sys.getsizeof(prepared) if plain else 1_000_000
