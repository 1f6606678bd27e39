"""Simulated worlds, where the truth is known."""

from adaptune.simulation.course import MOTIONS, SCENES, SENSORS, Course, SimulationError

__all__ = ["MOTIONS", "SCENES", "SENSORS", "Course", "SimulationError"]
