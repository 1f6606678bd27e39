"""Recorded sequences: scans from a sensor, and the reference trajectory they are judged by."""

from adaptune.recording.config import SequenceConfig
from adaptune.recording.scan import Imu, Recording, Scan, SequenceError

__all__ = ["Imu", "Recording", "Scan", "SequenceConfig", "SequenceError"]
