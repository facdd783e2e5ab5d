"""Conditional realism, the paper's future work: is p(tau|xi) that of the experts, with xi held fixed?

    one episode -> many experts, many rollouts under prior types -> their features (`Scene.described_by`), compared one by one -> mean over
    episodes, beside its floor: the same between two groups of experts of that size

Bins are the experts' alone (`Bins`): what an agent does widens none of them, and what no expert ever does has bins of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from rtc_mjx import dataset, evaluate, metrics, reference
from rtc_mjx.keys import stream
from rtc_mjx.scenes import Features, Scene, merged
from rtc_mjx.trained import Trained
from rtc_mjx.trajectory import Demonstration

BINS = 10  # between the least and the most that experts do
EPISODES = 64  # that are compared, at most


@dataclass(frozen=True)
class Bins:
    """Equal bins between the least and the most that any expert does; one below and one above for what none does.

    Attributes:
        low: the least.
        high: the most.
    """

    low: float
    high: float

    @classmethod
    def of(cls, *experts: np.ndarray) -> "Bins":
        """Those of one feature of all experts that there are."""
        return cls(float(min(np.min(x) for x in experts)), float(max(np.max(x) for x in experts)))

    def index(self, values: np.ndarray) -> Int[np.ndarray, "..."]:
        """The bin of each value: 0 below, 1 to BINS, BINS + 1 above."""
        inside = np.floor((np.asarray(values, float) - self.low) / max(self.high - self.low, 1e-12) * BINS)
        held = 1 + np.clip(inside, 0, BINS - 1).astype(int)
        return np.where(values < self.low, 0, np.where(values > self.high, BINS + 1, held))

    def jsd(self, ours: np.ndarray, theirs: np.ndarray) -> float:
        """Divergence in bits between two samples."""
        return metrics.jsd(self.index(ours), self.index(theirs), bins=BINS + 2, limits=(-0.5, BINS + 1.5))


def realism(held: Trained, test: Demonstration, experts: int, watch: Callable[..., Any] = iter) -> dict[str, Any]:
    """Conditional realism: JSD in bits between p(tau|xi) of experts and of the agent, per feature, mean over episodes.

    Args:
        held: what was trained.
        test: demonstrations; the first EPISODES of them are compared, all say what experts do.
        experts: of each episode, and rollouts.
        watch: goes through the parts of the work.

    Returns:
        By feature what `compared` says.

    Raises:
        DivergedError: a rollout is not finite.
    """
    scene, count = held.config.scene, min(EPISODES, len(jax.tree.leaves(test)[0]))
    mine = jax.tree.map(lambda x: x[:count], test)
    others = dataset.without_truth(dataset.by_others(scene, count, dataset.TEST, 2 * experts))
    theirs, all_experts = _described(scene, mine, others), reference.expert_features(scene, test)
    ours = evaluate.roller(held.learner, experts, watch)(held.networks, mine, {}, stream("type shift", 3))["prior"]
    evaluate.check_finite(ours[evaluate.FINITE], "prior")
    if scene.agents > 1:  # each agent by itself: of (episodes, experts, agents, ...) and (seeds, rollouts, episodes, agents, ...)
        theirs = {name: merged(scene, x.swapaxes(1, 2)) for name, x in theirs.items()}
        ours = {name: x.reshape(*x.shape[:2], -1, *x.shape[4:]) for name, x in ours.items() if x.ndim > 3}
    features = {
        name: compared(ours[name], theirs[name], Bins.of(theirs[name], all_experts[name]), scene.agents) for name in scene.described_by
    }
    return {"episodes": count, "experts": experts, "features": features}


def compared(ours: np.ndarray, theirs: np.ndarray, bins: Bins, agents: int = 1) -> dict[str, Any]:
    """One feature of rollouts (seeds, rollouts, rows, ...) and of twice as many experts (rows, experts, ...), compared row by row.

    Args:
        ours: a row is an agent of an episode; all agents of an episode are neighbours.
        theirs: the first half of the experts is compared with, the second half is the floor.
        bins: of the experts.
        agents: of an episode.

    Returns:
        `agent`, a list over seeds, the `interval` of its mean over seeds (bootstrap over episodes), `floor` and `floor_interval`, the
        same between the two halves of the experts, and the `range` of the bins.
    """
    count = theirs.shape[1] // 2
    first, second = theirs[:, :count], theirs[:, count:]
    agent = np.stack([_by_episode(of_seed.swapaxes(0, 1), first, bins, agents) for of_seed in ours])
    floor = _by_episode(second, first, bins, agents)
    return {
        "agent": [float(np.mean(of_seed)) for of_seed in agent],
        "interval": _interval(np.mean(agent, axis=0)),
        "floor": float(np.mean(floor)),
        "floor_interval": _interval(floor),
        "range": [bins.low, bins.high],
    }


def _by_episode(ours: np.ndarray, theirs: np.ndarray, bins: Bins, agents: int) -> Float[np.ndarray, "episodes"]:
    """The divergence between two samples of each row, mean over the agents of each episode."""
    rows = [bins.jsd(a, b) for a, b in zip(ours, theirs, strict=True)]
    return np.mean(np.reshape(rows, (-1, agents)), axis=1)


def _interval(episodes: Float[np.ndarray, "episodes"]) -> list[float]:
    return [float(end) for end in metrics.bootstrap(episodes)]


def _described(scene: Scene, mine: Demonstration, others: Demonstration) -> Features:
    """Features of other experts' trajectories in the episodes of demonstrations: (episodes, experts)."""
    count, experts = jax.tree.leaves(others)[0].shape[:2]
    tracks = jax.tree.map(lambda x: x.reshape(count * experts, *x.shape[2:]), others.trajectory)
    held = reference.features(scene, mine, np.repeat(np.arange(count), experts), tracks)
    return {name: x.reshape(count, experts, *x.shape[1:]) for name, x in held.items()}
