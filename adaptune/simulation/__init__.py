"""Simulated worlds, where the truth is known."""

from adaptune.simulation.course import Course, SceneLeg, SimulationError
from adaptune.simulation.scenes import SCENES
from adaptune.simulation.sensors import MOTIONS, SENSORS

__all__ = ["MOTIONS", "SCENES", "SENSORS", "Course", "SceneLeg", "SimulationError"]
