"""A map of landmark states drawn from experience, and routes over it to far goals (thesis Ch. 4)."""

from rpg.landmarks.config import PlannerConfig
from rpg.landmarks.distances import Distance
from rpg.landmarks.landmark_map import LandmarkMap
from rpg.landmarks.planner import LandmarkPlanner

__all__ = ["Distance", "LandmarkMap", "LandmarkPlanner", "PlannerConfig"]
