"""Recorded sequences: scans from a sensor, and the reference trajectory they are judged by."""

from adaptune.sequence.bag import BagSequence, SequenceError
from adaptune.sequence.config import SequenceConfig, open_sequence
from adaptune.sequence.scan import Scan

__all__ = ["BagSequence", "Scan", "SequenceConfig", "SequenceError", "open_sequence"]
