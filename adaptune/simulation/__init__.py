"""Simulated worlds, where the truth is known."""

from adaptune.simulation.course import Course, SceneLeg, SimulationError
from adaptune.simulation.motion import MOTIONS
from adaptune.simulation.recording import as_sequence, record
from adaptune.simulation.scenes import SCENES
from adaptune.simulation.sensors import SENSORS
from adaptune.simulation.simulate import SimulatedScan, simulate

__all__ = [
    "MOTIONS",
    "SCENES",
    "SENSORS",
    "Course",
    "SceneLeg",
    "SimulatedScan",
    "SimulationError",
    "as_sequence",
    "record",
    "simulate",
]
