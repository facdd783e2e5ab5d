"""How realistic simulated agents are, by the measures of the Waymo Open Sim Agents Challenge."""

from rtc_mjx.sim_agents.features import features
from rtc_mjx.sim_agents.inputs import LoggedAgents, RoadEdges, StopLines, stop_lines
from rtc_mjx.sim_agents.score import ESTIMATES, realism

__all__ = ["ESTIMATES", "LoggedAgents", "RoadEdges", "StopLines", "features", "realism", "stop_lines"]
