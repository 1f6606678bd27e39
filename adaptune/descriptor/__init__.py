"""Environment descriptors of scans."""

from adaptune.descriptor.base import (
    DESCRIPTORS,
    Describer,
    Descriptor,
    DescriptorError,
    averaged,
    check_descriptor,
    descriptor,
    lowest_elevation,
)

__all__ = [
    "DESCRIPTORS",
    "Describer",
    "Descriptor",
    "DescriptorError",
    "averaged",
    "check_descriptor",
    "descriptor",
    "lowest_elevation",
]
