"""The methods, as data: which types a branch acts under, and what it loses.

A branch takes a slice of each minibatch. Slices may overlap: InfoMGAIL clones and plays every episode, under different types;
RTC splits the minibatch at `encoder_share`, the paper's f. Whether L_adv is of all branches that name it is a setting of its own
(`losses.LossWeights.fakes`). No method is compared by name anywhere.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from rtc_mjx.agent_types import READINGS, Continuous, Discrete, NoType, Pointing, TypeSpace
from rtc_mjx.errors import UsageError
from rtc_mjx.losses import CLOSED_LOOP, Fakes
from rtc_mjx.models import ModelOptions

Share = Literal["all", "encoder_share", "rest"]


@dataclass(frozen=True)
class Branch:
    """One way in which a method uses a part of the minibatch.

    Attributes:
        types: key of `agent_types.SOURCES`.
        losses: keys of `losses.LOSSES`.
        share: all of the minibatch, its first `encoder_share`, or what that leaves.
    """

    types: str
    losses: tuple[str, ...]
    share: Share = "all"

    @property
    def closed_loop(self) -> bool:
        """Whether a loss reads a rollout."""
        return bool(CLOSED_LOOP & set(self.losses))

    def rows(self, batch: int, encoder_share: float) -> slice:
        """The rows of the minibatch that this branch takes."""
        split = round(batch * encoder_share)
        return {"all": slice(0, batch), "encoder_share": slice(0, split), "rest": slice(split, batch)}[self.share]


@dataclass(frozen=True)
class Method:
    """A method.

    Attributes:
        branches: what it does with a minibatch.
        kind: of its types.
        test_types: where a type comes from when the agent is on its own.
    """

    branches: tuple[Branch, ...]
    kind: Literal["none", "continuous", "discrete", "label"] = "none"
    test_types: str = "none"

    @property
    def parts(self) -> frozenset[str]:
        """The networks it has beside the policy."""
        by_source = {"encoder": {"encoder", "prior"}, "prior": {"prior"}, "inference": {"inference"}, "label": {"prior"}}
        by_loss = {"adversarial": {"discriminator"}, "policy_gradient": {"discriminator", "value"}}
        used = [by_source.get(b.types, set()) for b in self.branches] + [by_loss.get(x, set()) for b in self.branches for x in b.losses]
        return frozenset().union(*used)

    @property
    def closed_loop(self) -> tuple[Branch, ...]:
        """The branches that have a loss on rollouts."""
        return tuple(branch for branch in self.branches if branch.closed_loop)

    def faking(self, fakes: Fakes) -> tuple[Branch, ...]:
        """The branches whose rollouts L_adv is of and the discriminator learns from (`losses.LossWeights.fakes`)."""
        as_tested = tuple(branch for branch in self.closed_loop if branch.types == self.test_types)
        return as_tested if fakes == "test" and as_tested else self.closed_loop

    @property
    def encodes(self) -> bool:
        """Whether it learns an encoder."""
        return "encoder" in self.parts

    @property
    def reads(self) -> str:
        """The source (of `agent_types.READINGS`) that reads a type off a demonstration, for paired and shuffled types; '' without one."""
        return next((branch.types for branch in self.branches if branch.types in READINGS), "")

    def space(self, options: ModelOptions, labels: int = 0) -> TypeSpace:
        """The space of its types; `labels`: how many the scene's hand-made types are."""
        spaces: dict[str, TypeSpace] = {
            "none": NoType(),
            "continuous": Continuous(options.type_size, options.prior_components, options.posterior_components),
            "discrete": Discrete(options.type_count),
            "label": Pointing(labels),
        }
        return spaces[self.kind]


CLONE, PLAY = ("cloning",), ("adversarial",)
ENCODED = ("cloning", "reconstruction", "type_kl", "adversarial")

BC = Method((Branch("none", CLONE),))
GAIL = Method((Branch("none", (*CLONE, "policy_gradient", "value")),))
MGAIL = Method((Branch("none", CLONE + PLAY),))
INFO_MGAIL = Method((Branch("inference", CLONE), Branch("fixed_prior", (*PLAY, "type_info"))), test_types="fixed_prior")
SYMPHONY = Method((Branch("label", (*CLONE, *PLAY, "type_nll")),), kind="label", test_types="prior")
NAIVE_HIERARCHY = Method((Branch("encoder", ENCODED),), test_types="prior")
RTC = Method((Branch("encoder", ENCODED, "encoder_share"), Branch("prior", (*PLAY, "type_recovery"), "rest")), test_types="prior")

METHODS: Mapping[str, Method] = {
    "bc": BC,
    "gail": GAIL,
    "mgail": MGAIL,
    "info_mgail_c": replace(INFO_MGAIL, kind="continuous"),
    "info_mgail_d": replace(INFO_MGAIL, kind="discrete"),
    "symphony": SYMPHONY,
    "naive_hierarchy_c": replace(NAIVE_HIERARCHY, kind="continuous"),
    "naive_hierarchy_d": replace(NAIVE_HIERARCHY, kind="discrete"),
    "rtc_c": replace(RTC, kind="continuous"),
    "rtc_d": replace(RTC, kind="discrete"),
}


def method_name(given: str) -> str:
    """The full name of a method; a name without _c or _d means continuous types.

    Raises:
        UsageError: there is no such method; the message lists those there are.
    """
    for name in (given, f"{given}_c"):
        if name in METHODS:
            return name
    raise UsageError(f"--method {given}: no such method; there are {', '.join(METHODS)} ('rtc' alone means rtc_c)")
