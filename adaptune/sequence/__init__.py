"""Recorded sequences: scans from a sensor, and the reference trajectory they are judged by."""

from adaptune.sequence.scan import Scan

__all__ = ["Scan"]
