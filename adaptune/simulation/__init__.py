"""Simulated worlds, where the truth is known."""

from adaptune.simulation.course import MOTIONS, SENSORS, Course, SimulationError
from adaptune.simulation.scenes import SCENES

__all__ = ["MOTIONS", "SCENES", "SENSORS", "Course", "SimulationError"]
