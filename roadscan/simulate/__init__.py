"""Simulates a survey with known truth as raw logs. It shares no geometry code with the pipeline."""

from roadscan.simulate.run import SimulatedSurvey, simulate
from roadscan.simulate.scene import Scene, shipped_scenes

__all__ = ["Scene", "SimulatedSurvey", "shipped_scenes", "simulate"]
