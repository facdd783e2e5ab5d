"""Settings as frozen dataclasses, and as the plain table that JSON holds."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from rtc_mjx.cluster import Hardware
from rtc_mjx.learner import Learner, OptimiserOptions
from rtc_mjx.losses import LossWeights
from rtc_mjx.methods import METHODS, method_name
from rtc_mjx.models import ModelOptions, Statistics
from rtc_mjx.scenes import DoubleGoal, Scene

SEEDS = ("seeds", "first_seed")  # which trainings; all other settings say what each of them does
OF_VALUE = (  # read by methods with a V, and by no other
    *("losses.policy_gradient", "losses.policy_gradient_start", "losses.policy_gradient_ramp", "losses.value"),
    *("optimiser.value_rate", "optimiser.discount", "optimiser.trace"),
)
OF_RECOVERY = ("losses.type_recovery", "losses.type_recovery_ramp")  # read by RTC


@dataclass(frozen=True)
class Experts:
    """Demonstrations.

    Attributes:
        train: demonstrations to learn from.
        test: demonstrations to compare with, during training and in `evaluate`.
    """

    train: int = 8192
    test: int = 2048


@dataclass(frozen=True)
class Intervals:
    """Numbers of updates between events; `test` and `save` are multiples of `log`.

    Attributes:
        log: updates from one line of metrics to the next.
        test: updates from one test on test episodes to the next, a multiple of `log`.
        save: updates from one checkpoint to the next, a multiple of `log`.
    """

    log: int = 100
    test: int = 500
    save: int = 500


@dataclass(frozen=True)
class Config:
    """Everything that determines a training.

    Attributes:
        scene: settings of the scene.
        method: which method.
        seeds: how many trainings at once, in one program.
        first_seed: the seed of the first; the others follow.
        updates: length of the training.
        batch: episodes of a minibatch.
        encoder_share: share of the minibatch that takes types from the encoder, where a method has both (the paper's f).
        run: directory of the run; runs/<scene>/<method> if not given.
        resume: go on with the run in that directory.
        model: networks and types.
        losses: weights.
        optimiser: gradients and rates.
        experts: demonstrations.
        every: intervals.
        hardware: where it runs; it is not written down, since no result depends on it.
    """

    scene: Scene = field(default_factory=DoubleGoal)
    method: str = "rtc_c"
    seeds: int = 1
    first_seed: int = 0
    updates: int = 4000
    batch: int = 64
    encoder_share: float = 0.5
    run: Path | None = None
    resume: bool = False
    model: ModelOptions = ModelOptions()
    losses: LossWeights = LossWeights()
    optimiser: OptimiserOptions = OptimiserOptions()
    experts: Experts = Experts()
    every: Intervals = Intervals()
    hardware: Annotated[Hardware, tyro.conf.arg(name="")] = Hardware()

    @property
    def folder(self) -> Path:
        """The run directory."""
        return self.run or Path("runs") / self.scene.name / self.method

    @property
    def all_seeds(self) -> range:
        """The seeds that are trained."""
        return range(self.first_seed, self.first_seed + self.seeds)

    def learner(self, statistics: Statistics) -> Learner:
        """What these settings train, given the statistics of its demonstrations."""
        method = METHODS[self.method]
        return Learner(
            scene=self.scene,
            method=method,
            space=method.space(self.model, self.scene.labels),
            statistics=statistics,
            model=self.model,
            weights=self.losses,
            optimiser=self.optimiser,
            updates=self.updates,
            batch=self.batch,
            encoder_share=self.encoder_share,
        )


def to_dict(config: Config) -> dict[str, Any]:
    """The settings as JSON holds them; the scene by name and settings, without what only places the run."""
    table = dataclasses.asdict(config)
    table["scene"] = {"name": config.scene.name, **table["scene"]}
    table["run"], table["resume"] = None, False
    del table["hardware"]
    return table


def flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name."""
    out: dict[str, Any] = {}
    for key, value in table.items():
        out |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return out


def differing(ours: Config, theirs: Config) -> list[tuple[str, Any, Any]]:
    """The settings but for seeds in which two runs differ, of those that the method of the second reads, with the values of both."""
    one, other = (flat(to_dict(held)) for held in (ours, theirs))
    alike = {*SEEDS, *unread(theirs.method)}
    return [(name, one[name], other.get(name)) for name in one if one[name] != other.get(name) and name not in alike]


def unread(method: str) -> frozenset[str]:
    """Settings that a method does not read: two runs of it that differ in these are alike."""
    held = METHODS[method_name(method)]
    read = {
        OF_VALUE: "value" in held.parts,
        OF_RECOVERY: any("type_recovery" in branch.losses for branch in held.branches),
        ("losses.fakes",): held.faking("test") != held.closed_loop,
    }
    return frozenset(name for names, does in read.items() if not does for name in names)


def later(method: str) -> frozenset[str]:
    """Settings that a run may lack since they came later: those its method does not read, and those whose default is what was before."""
    return unread(method) | {"model.posterior_components", "losses.discriminator_penalty_agent", "losses.fakes", *OF_RECOVERY}
