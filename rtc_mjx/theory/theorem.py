"""Theorem 1 of Igl et al., section III, put to random instances: what it says, what it needs, and where it breaks.

As our notes state it: under conditional type shift the agent's actions say less about the state than the expert's,
I(S, A_hat) < I(S, A), and therefore they are noisier, H(A_hat|S) > H(A|S). Here A is what the policy does under paired types (a policy that
reconstructs plays the expert), A_hat what it does under types drawn from the prior, which is the types' marginal. The paper may
assume more than our notes hold. What the tables say:

- I(S, A_hat) < I(S, A) does *not* follow from conditional shift and a deterministic policy alone: `breaking` is an instance of two
  states and two types, and more than a third of random ones have it the other way round. Nor does it follow from H(A|G) = 0, that in
  training the type says the action: `breaking` has that too, since it says nothing of a type in states where it was never met.
- It does follow where the type leaves less open than the actions tell: I(S, A_hat) <= I(S, A_hat | G) <= H(A_hat | G), G being
  independent of S, so that `residual_hat` < I(S, A) suffices. Solution 2 has a residual of zero; a policy that deviates from "the type
  is the action" with probability at most epsilon has one of at most `fano(epsilon)`.
- H(A_hat|S) - H(A|S) = (I(S,A) - I(S,A_hat)) + (H(A_hat) - H(A)). The last step needs H(A_hat) >= H(A), or at least not to lose
  more of it than of the information: `counterexample`. Solution 2 keeps the actions' frequencies, so it meets that. Where each type has
  actions of its own in every state, H(A|S) = H(G|S) and H(A_hat|S) = H(G): the last step then holds whether the claim does or not.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtc_mjx.pytree import pytree
from rtc_mjx.theory import tables

Values = Array | np.ndarray  # random instances are drawn and counted in numpy, compared in JAX

STATES, TYPE_COUNT, ACTIONS = 3, 2, 4  # of a random instance; actions enough for each type to have its own
MARGIN = 1e-9  # nats: smaller differences are rounding
NEARLY = 0.02  # with what probability the nearly state-blind policy looks at the state


@pytree
class Instance:
    """A policy and the types it was trained under.

    Attributes:
        state_type: q(s, g).
        policy: pi(a|s,g).
    """

    state_type: Float[Values, "*batch states types"]
    policy: Float[Values, "*batch states types actions"]


@pytree
class Comparison:
    """Both sides of the theorem, in nats.

    Attributes:
        information: I(S, A), paired types.
        information_hat: I(S, A_hat), types from the prior.
        entropy: H(A).
        entropy_hat: H(A_hat).
        shift: I(G; S), conditional type shift.
        residual: H(A | G), what the type leaves open in training.
        residual_hat: H(A_hat | G), what the type leaves open at test.
    """

    information: Float[Values, "*batch"]
    information_hat: Float[Values, "*batch"]
    entropy: Float[Values, "*batch"]
    entropy_hat: Float[Values, "*batch"]
    shift: Float[Values, "*batch"]
    residual: Float[Values, "*batch"]
    residual_hat: Float[Values, "*batch"]

    @property
    def noise(self) -> Values:
        """H(A | S)."""
        return self.entropy - self.information

    @property
    def noise_hat(self) -> Values:
        """H(A_hat | S)."""
        return self.entropy_hat - self.information_hat

    @property
    def shifted(self) -> Values:
        """The theorem's hypothesis: there is conditional type shift."""
        return self.shift > MARGIN

    @property
    def determined(self) -> Values:
        """H(A | G) = 0: in training the type says the action."""
        return self.residual < MARGIN

    @property
    def bounded(self) -> Values:
        """The hypothesis under which we can prove the claim: H(A_hat | G) < I(S, A)."""
        return self.residual_hat < self.information - MARGIN

    @property
    def claim(self) -> Values:
        """I(S, A_hat) < I(S, A)."""
        return self.information_hat < self.information - MARGIN

    @property
    def reversed(self) -> Values:
        """I(S, A_hat) > I(S, A): the claim does not just miss by a tie."""
        return self.information_hat > self.information + MARGIN

    @property
    def as_varied(self) -> Values:
        """The condition that the last step needs: H(A_hat) >= H(A)."""
        return self.entropy_hat >= self.entropy - MARGIN

    @property
    def last_step(self) -> Values:
        """H(A_hat | S) > H(A | S)."""
        return self.noise_hat > self.noise


def compare(instance: Instance) -> Comparison:
    """Both sides of the theorem for one instance."""
    types, policy = jnp.asarray(instance.state_type), jnp.asarray(instance.policy)
    shuffled = tables.independent(types)
    paired, prior = (jnp.einsum("sg,sga->sa", joint, policy) for joint in (types, shuffled))
    return Comparison(
        information=tables.mutual_information(paired),
        information_hat=tables.mutual_information(prior),
        entropy=tables.entropy(jnp.sum(paired, axis=0)),
        entropy_hat=tables.entropy(jnp.sum(prior, axis=0)),
        shift=tables.conditional_shift(types),
        residual=tables.conditional_entropy(jnp.einsum("sg,sga->ga", types, policy)),
        residual_hat=tables.conditional_entropy(jnp.einsum("sg,sga->ga", shuffled, policy)),
    )


def fano(epsilon: Float[Array, ""] | float, actions: int) -> Float[Array, ""]:
    """h(epsilon) + epsilon log(actions - 1), in nats: the largest entropy of an action that is a given one but with probability epsilon."""
    chosen = jnp.array([1 - epsilon, epsilon])
    return tables.entropy(chosen) + epsilon * jnp.log(float(max(1, actions - 1)))


def counterexample() -> Instance:
    """The claim holds, its last step does not. Found by search; q(s,g) was rounded and sums to 1.0001."""
    choice = jnp.array([[1, 2], [2, 2], [0, 2]])
    types = jnp.array([[0.0811, 0.1526], [0.0131, 0.6218], [0.0413, 0.0902]])
    return Instance(types / jnp.sum(types), jnp.eye(3)[choice])


def breaking() -> Instance:
    """The claim itself does not hold, though in training the type says the action and the action the type (ours, made by hand).

    Type 0 heeds the state, but in training it came up in state 0 alone, where that does not show; type 1 does not heed it. Under prior
    types, type 0 meets state 1 and reacts to it: the actions then say more about the state, not less.
    """
    choice = jnp.array([[0, 2], [1, 2]])
    return Instance(jnp.array([[0.5, 0.4], [0.0, 0.1]]), jnp.eye(3)[choice])


Generator = Callable[[np.random.Generator, int], Instance]


def _types(random: np.random.Generator, count: int) -> Float[np.ndarray, "count states types"]:
    return random.dirichlet(np.full(STATES * TYPE_COUNT, 0.5), count).reshape(count, STATES, TYPE_COUNT)


def _reactions(random: np.random.Generator, count: int) -> Float[np.ndarray, "count states types actions"]:
    return random.dirichlet(np.full(ACTIONS, 0.5), (count, STATES, TYPE_COUNT))


def _own_actions(random: np.random.Generator, count: int) -> Float[np.ndarray, "count states types actions"]:
    """An action for each type, whatever the state; no two types share one."""
    choice = random.permuted(np.tile(np.arange(ACTIONS), (count, 1)), axis=1)[:, None, :TYPE_COUNT]
    return np.eye(ACTIONS)[np.tile(choice, (1, STATES, 1))]


def any_policy(random: np.random.Generator, count: int) -> Instance:
    """Any joint of states and types, any policy."""
    return Instance(_types(random, count), _reactions(random, count))


def deterministic(random: np.random.Generator, count: int) -> Instance:
    """Any deterministic policy: it reconstructs the expert that it defines without error."""
    return Instance(_types(random, count), np.eye(ACTIONS)[random.integers(0, ACTIONS, (count, STATES, TYPE_COUNT))])


def readable(random: np.random.Generator, count: int) -> Instance:
    """Deterministic, and every type has actions of its own: the encoder needs nothing but the action."""
    each = ACTIONS // TYPE_COUNT
    choice = random.integers(0, each, (count, STATES, TYPE_COUNT)) + each * np.arange(TYPE_COUNT)
    return Instance(_types(random, count), np.eye(ACTIONS)[choice])


def determined(random: np.random.Generator, count: int) -> Instance:
    """H(A|G) = 0: in training the type says the action. A third of the pairs of state and type never come up; there, any action."""
    types = _types(random, count)
    types = np.where(random.random(types.shape) < 1 / 3, 0.0, types)
    met = np.any(types > 0, axis=(1, 2), keepdims=True)
    types = np.where(met, types, 1 / (STATES * TYPE_COUNT))
    reactions = np.eye(ACTIONS)[random.integers(0, ACTIONS, (count, STATES, TYPE_COUNT))]
    policy = np.where((types > 0)[..., None], _own_actions(random, count), reactions)
    return Instance(types / np.sum(types, axis=(1, 2), keepdims=True), policy)


def nearly_blind(random: np.random.Generator, count: int) -> Instance:
    """As solution 2, but with probability NEARLY any reaction to the state."""
    policy = (1 - NEARLY) * _own_actions(random, count) + NEARLY * _reactions(random, count)
    return Instance(_types(random, count), policy)


def blind(random: np.random.Generator, count: int) -> Instance:
    """Solution 2: the action is a function of the type alone."""
    return Instance(_types(random, count), _own_actions(random, count))


HYPOTHESES: dict[str, Generator] = {
    "any policy": any_policy,
    "deterministic": deterministic,
    "deterministic, type in action": readable,
    "H(A|G) = 0 in training": determined,
    "nearly state-blind": nearly_blind,
    "state-blind (solution 2)": blind,
}


def compared(hypothesis: str, instances: int, seed: int = 0) -> Comparison:
    """Comparisons of random instances that meet a hypothesis, along one axis; in double precision, for MARGIN to mean something."""
    drawn = HYPOTHESES[hypothesis](np.random.default_rng(seed), instances)
    with jax.enable_x64(True):
        return jax.device_get(_compare_all(drawn))


_compare_all = jax.jit(jax.vmap(compare))


EXAMPLES: dict[str, Callable[[], Instance]] = {"counterexample to the last step": counterexample, "breaks the claim": breaking}


def example(make: Callable[[], Instance]) -> Comparison:
    """The comparison of one given instance, in double precision."""
    with jax.enable_x64(True):
        return jax.device_get(compare(make()))


def example_tables(make: Callable[[], Instance]) -> dict[str, np.ndarray]:
    """The tables of one given instance: q(s,g), the policy, and what is played, p(s,a) in training and p(s,a_hat) at test."""
    with jax.enable_x64(True):
        held = make()
        types, policy = jnp.asarray(held.state_type), jnp.asarray(held.policy)
        plays = {"training_actions": types, "test_actions": tables.independent(types)}
        shown = {name: jnp.einsum("sg,sga->sa", joint, policy) for name, joint in plays.items()}
        return jax.device_get({"state_type": types, "policy": policy, **shown})


def census(found: Comparison) -> dict[str, int]:
    """How many instances keep and break what; only those with conditional type shift count."""
    held = found.shifted
    counts = {
        "instances": held,
        "claim": held & found.claim,
        "reversed": held & found.reversed,
        "determined": held & found.determined,
        "determined_without_claim": held & found.determined & ~found.claim,
        "bounded": held & found.bounded,
        "bounded_without_claim": held & found.bounded & ~found.claim,
        "last_step_fails": held & found.claim & ~found.last_step,
        "as_varied": held & found.claim & found.as_varied,
        "as_varied_and_last_step_fails": held & found.claim & found.as_varied & ~found.last_step,
    }
    return {name: int(np.sum(which)) for name, which in counts.items()}
