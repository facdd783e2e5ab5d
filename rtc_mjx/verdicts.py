"""Claims about results, and what results say to them: quantities, relations between two of them, and a verdict over seeds.

    results -> left and right of a claim, a number a seed -> margin of each seed -> interval, sign-flip p -> yes, no or a tie

A margin is above 0 where a seed does what the claim says.
"""

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rtc_mjx import over_seeds, results
from rtc_mjx.over_seeds import Seeds
from rtc_mjx.results import Record

LEAST_SEEDS = 4  # with fewer no verdict is given
NOT_TESTED = "not tested"  # the verdict where a result is missing

Held = Mapping[str, Record]
Numbers = Seeds | float


@dataclass(frozen=True)
class Quantity:
    """A number of each seed, computed from results.

    Attributes:
        text: what it is.
        of: computes it; `KeyError` where results do not have what it needs.
        names: of the results that it needs.
    """

    text: str
    of: Callable[[Held], Numbers]
    names: frozenset[str] = frozenset()

    def __add__(self, other: "Quantity") -> "Quantity":
        """The sum, of the seeds that both have."""
        return _joined(self, other, operator.add, "{} + {}")

    def __sub__(self, other: "Quantity") -> "Quantity":
        """The difference, of the seeds that both have."""
        return _joined(self, other, operator.sub, "{} - {}")

    def __rmul__(self, factor: float) -> "Quantity":
        """So many times the number."""
        return _joined(constant(factor), self, operator.mul, "{} x {}")


def _joined(left: Quantity, right: Quantity, of: Callable[[float, float], float], text: str) -> Quantity:
    return Quantity(text.format(left.text, right.text), lambda held: both(of, left.of(held), right.of(held)), left.names | right.names)


def both(of: Callable[[float, float], float], left: Numbers, right: Numbers) -> Numbers:
    """A function of two numbers, seed by seed; of the seeds that both have."""
    if isinstance(left, Mapping) and isinstance(right, Mapping):
        return {seed: of(left[seed], right[seed]) for seed in sorted(set(left) & set(right))}
    if isinstance(left, Mapping):
        return {seed: of(x, float(right)) for seed, x in left.items()}  # type: ignore[arg-type]
    if isinstance(right, Mapping):
        return {seed: of(left, x) for seed, x in right.items()}
    return of(left, right)


def constant(value: float, unit: str = "") -> Quantity:
    """The same number for every seed."""
    return Quantity(f"{value:g}{unit and ' '}{unit}", lambda held: value)


def metric(name: str, of: str, source: str = "prior") -> Quantity:
    """A metric of a result under a source of types."""
    told = f"{of}'s {name.replace('_', ' ')}" + (f" ({source})" if source != "prior" else "")
    return Quantity(told, lambda held: results.metric(held[of], source, name), frozenset((of,)))


def lost(name: str, of: str) -> Quantity:
    """Conditional shift in a metric of which more is better: what types of another episode cost, beside the episode's own."""
    return replace(
        metric(name, of, "paired") - metric(name, of, "shuffled"), text=f"{of}'s {name.replace('_', ' ')} lost (paired - shuffled)"
    )


def gained(name: str, of: str) -> Quantity:
    """Conditional shift in a metric of which less is better: shuffled less paired."""
    return replace(
        metric(name, of, "shuffled") - metric(name, of, "paired"), text=f"{of}'s {name.replace('_', ' ')} added (shuffled - paired)"
    )


def bits(of: str) -> Quantity:
    """What a probe finds that types tell of xi."""
    return Quantity(f"{of}'s I(g; xi)", lambda held: results.seeds(held[of], _told(held[of])["bits"]), frozenset((of,)))


def null(of: str) -> Quantity:
    """Below this are 95 % of what the same probe finds where types are permuted."""
    return Quantity(f"{of}'s null (95 %)", lambda held: float(_told(held[of])["null_95"]), frozenset((of,)))


def _told(record: Record) -> Mapping[str, Any]:
    found = record["type_shift"]["information"]["xi"]
    if record["type_shift"]["probe"]["control"]["bits"] <= 0:  # of what surely is there
        raise KeyError("the probe finds nothing, in its control neither: too few demonstrations")
    return found


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper as a relation between two quantities.

    Attributes:
        scenes: where it is tested.
        text: the sentence, in our words.
        where: the paper says it.
        left: one side.
        relation: '<=' or '>='.
        right: the other.
        threshold: what we made of the sentence where the paper gives no number; ours.
        why: it is not reproduced, as far as is known.
    """

    scenes: tuple[str, ...]
    text: str
    where: str
    left: Quantity
    relation: str
    right: Quantity
    threshold: str = "-"
    why: str = "not known"

    @property
    def names(self) -> frozenset[str]:
        """Of the results that it needs."""
        return self.left.names | self.right.names

    def margin(self, held: Held) -> Seeds:
        """Of each seed, by how much it does what the claim says; below 0 where it does not.

        Raises:
            KeyError: the results do not have what it needs.
        """
        left, right = self.left.of(held), self.right.of(held)
        found = both(operator.sub, left, right) if self.relation == ">=" else both(operator.sub, right, left)
        if not isinstance(found, Mapping):
            raise KeyError("seeds")
        return found


def verdict(margin: Seeds) -> tuple[str, float]:
    """Yes, no or a tie, with the number of seeds; and the p-value of the sign-flip test."""
    values = np.array([margin[seed] for seed in sorted(margin)])
    p, found = over_seeds.sign_flip(values), over_seeds.interval(values.tolist())
    if len(values) < LEAST_SEEDS or found is None:
        return f"too few seeds to tell ({len(values)})", p
    low, high = found
    apart = (low > 0 or high < 0) and (p < 0.05 or len(values) < over_seeds.DECIDING)
    said = ("yes" if low > 0 else "no") if apart else "tie: within the noise"
    return f"{said} ({len(values)} seeds)", p


def row(claim: Claim, held: Held) -> list[str]:
    """A claim's row: what was measured, and the verdict; or what there is no result of."""
    first = [claim.text, claim.where, claim.threshold]
    whole = results.finished(held)
    if absent := sorted(claim.names - set(whole)):
        failed = [f"{name} {held[name]['failed'].partition(':')[0]}" if name in held else f"{name} was not run" for name in absent]
        return [*first, "; ".join(failed), "", NOT_TESTED, ""]
    first_of, *others = [whole[name] for name in sorted(claim.names)]
    if not all(results.comparable(first_of, other) for other in others):
        return [*first, "tested on other recordings", "", NOT_TESTED, ""]
    try:
        margin = claim.margin(whole)
    except KeyError as error:
        return [*first, f"not measured ({error.args[0]})", "", NOT_TESTED, ""]
    if not margin:
        return [*first, "no seed in common", "", NOT_TESTED, ""]
    said, p = verdict(margin)
    told = f"{_number(claim.left, whole)} {claim.relation} {_number(claim.right, whole)}; margin {over_seeds.signed(list(margin.values()))}"
    return [*first, told, f"{p:.3g}", said, claim.why if said.startswith(("no", "tie")) else ""]


def _number(quantity: Quantity, held: Held) -> str:
    value = quantity.of(held)
    if not isinstance(value, Mapping):
        return quantity.text if quantity.text.startswith(f"{value:g}") else f"{quantity.text}: {value:.3g}"
    return f"{quantity.text}: {over_seeds.number(list(value.values()))}"
