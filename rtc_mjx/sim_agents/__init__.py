"""How realistic simulated agents are, by the measures of the Waymo Open Sim Agents Challenge."""

from rtc_mjx.sim_agents.features import features
from rtc_mjx.sim_agents.inputs import LoggedAgents, RoadEdges, StopLines, stop_lines
from rtc_mjx.sim_agents.recorded import Task, of_recording
from rtc_mjx.sim_agents.score import ESTIMATES, realism
from rtc_mjx.sim_agents.submission import Rollouts, places, rollouts

__all__ = [
    "ESTIMATES", "LoggedAgents", "RoadEdges", "Rollouts", "StopLines", "Task", "features", "of_recording", "places", "realism",
    "rollouts", "stop_lines",
]  # fmt: skip
