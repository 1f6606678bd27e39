"""Recorded sequences: scans from a sensor, and the reference trajectory they are judged by."""

from adaptune.sequence.config import SequenceConfig
from adaptune.sequence.imu import Imu
from adaptune.sequence.scan import Scan
from adaptune.sequence.sequence import Sequence, SequenceError

__all__ = ["Imu", "Scan", "Sequence", "SequenceConfig", "SequenceError"]
