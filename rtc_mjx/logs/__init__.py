"""Logged scenes: roads, signals and road users over time, wherever they come from."""

from rtc_mjx.logs.check import checked
from rtc_mjx.logs.scene import AMBER, CYCLIST, GREEN, NO_SIGNAL, PEDESTRIAN, RATE, RED, VEHICLE, LoggedScene, RoadGraph

__all__ = ["AMBER", "CYCLIST", "GREEN", "NO_SIGNAL", "PEDESTRIAN", "RATE", "RED", "VEHICLE", "LoggedScene", "RoadGraph", "checked"]
