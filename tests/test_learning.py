"""Laws of the learning rule, on every method there is."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from jax import random
from jax.test_util import check_grads
from learning import CLOSED_LOOP, ON_SCENE, SCENE, SCORED, begin, experts, gradients, learner, played

from rtc_mjx import gradients as learning
from rtc_mjx.agent_types import SOURCES
from rtc_mjx.config import unread
from rtc_mjx.gradients import Played
from rtc_mjx.losses import LOSSES, Case, LossWeights
from rtc_mjx.methods import METHODS
from rtc_mjx.models import Networks
from rtc_mjx.networks import Encoder, Layout, Reader, Scores
from rtc_mjx.rollout import rollout
from rtc_mjx.scenes import DoubleGoal, ItemSet
from rtc_mjx.updates import train_step

NOTHING = LossWeights(**{f.name: 0.0 for f in dataclasses.fields(LossWeights) if isinstance(f.default, float)}, adversarial_ramp=0)
ENCODING = tuple(name for name in ON_SCENE if METHODS[name].encodes)


def only(**weights):
    return dataclasses.replace(NOTHING, **weights)


def size(tree):
    return float(optax.tree.norm(tree))


def plain_loss(held, networks, batch, key):
    """All losses with the networks inside the simulation loop: what the two stages must differentiate."""
    types, play, extra, glance = random.split(key, 4)
    agent = held.agent(networks)
    typed = learning.infer(held, agent, batch, types)
    rollouts = plain_rollouts(held, agent, batch, typed, play)
    lost = learning.branch_losses(held, agent, batch, typed, rollouts, extra, frozenset(LOSSES))
    critic = learning.critic_loss(held, agent, batch, rollouts, glance)[0] if rollouts else 0.0
    return held.weights.total(lost, jnp.array(0)) + critic


def plain_rollouts(held, agent, batch, typed, key):
    """As `play_together` numbers and draws them."""
    rows = [np.arange(held.batch)[held.rows(b)] for b in held.closed_loop]
    if not rows:
        return None
    episodes, g = jax.tree.map(lambda x: x[np.concatenate(rows)], batch.episode), learning.joined_types(held, typed)
    nudge = jnp.zeros((SCENE.steps, agent.outputs))
    tracks = jax.vmap(lambda e, t, k: held.play(agent, e, t, k, nudge))(episodes, g, random.split(key, len(g)))
    return learning.credited(held, agent, Played(tracks, jnp.ones(len(g), bool)), g)


@pytest.mark.parametrize("method", ON_SCENE)
def test_two_stage_gradient_is_that_of_the_plain_loop(method, x64):
    more = {"discriminator_penalty_agent": 0.05, "type_recovery": 0.1, "type_recovery_ramp": 0}
    held = learner(method, weights=LossWeights(adversarial=0.7, adversarial_ramp=0, type_kl=0.1, **more))
    state, batch = begin(held)
    ours, _ = jax.jit(lambda n: gradients(held, n, batch, random.key(3), jnp.array(0)))(state.networks)
    plain = jax.jit(jax.grad(lambda n: plain_loss(held, n, batch, random.key(3))))(state.networks)
    assert size(plain.policy) > 1e-6
    assert size(jax.tree.map(jnp.subtract, ours, plain)) < 1e-9 * size(plain)


def test_gradient_through_rollouts_matches_differences(x64):
    """Of L_adv alone with noise held fixed and one component, where nothing is chosen: exact pathwise, by central differences."""
    held = learner("mgail", weights=only(adversarial=1.0))
    held = dataclasses.replace(held, model=dataclasses.replace(held.model, mixture=1))
    state, batch = begin(held)
    ours, _ = jax.jit(lambda n: gradients(held, n, batch, random.key(3), jnp.array(0)))(state.networks)
    agent_side = jax.jit(lambda p: plain_loss(held, dataclasses.replace(state.networks, policy=p), batch, random.key(3)))
    leaves, tree = jax.tree.flatten(state.networks.policy)
    for draw in range(3):
        way = [random.normal(random.key(10 * draw + i), x.shape) for i, x in enumerate(leaves)]
        up, down = (agent_side(jax.tree.unflatten(tree, [x + h * w for x, w in zip(leaves, way, strict=True)])) for h in (1e-6, -1e-6))
        slope = sum(float(jnp.sum(g * w)) for g, w in zip(jax.tree.leaves(ours.policy), way, strict=True))
        # the discriminator's own loss moves with the rollouts too, but is not the policy's to lower: take it off
        critic = [
            _critic(held, state, batch, jax.tree.unflatten(tree, [x + h * w for x, w in zip(leaves, way, strict=True)]))
            for h in (1e-6, -1e-6)
        ]
        assert abs((float(up - down) - (critic[0] - critic[1])) / 2e-6 - slope) < 1e-5 * (1 + abs(slope))


def _critic(held, state, batch, policy):
    agent = held.agent(dataclasses.replace(state.networks, policy=policy))
    types, play, _, glance = random.split(random.key(3), 4)
    _, rollouts = played(held, agent.networks, batch, types, play)
    return float(learning.critic_loss(held, agent, batch, rollouts, glance)[0])


@pytest.mark.parametrize("method", ["rtc_c", "rtc_d"])
def test_prior_gets_no_gradient_from_adversarial_loss(method):
    held = learner(method, weights=only(adversarial=1.0))
    state, batch = begin(held)
    gradient, _ = gradients(held, state.networks, batch, random.key(0), jnp.array(0))
    assert np.all(gradient.prior == 0)
    assert size(gradient.policy) > 0 and size(gradient.encoder) > 0  # reaches the encoder through its own branch


@pytest.mark.parametrize("method", ["rtc_c", "rtc_d"])
def test_rollouts_of_both_branches_are_fakes_for_the_discriminator(method):
    held = learner(method)
    state, batch = begin(held)
    agent = held.agent(state.networks)
    _, rollouts = played(held, state.networks, batch, random.key(1), random.key(2))
    assert len(rollouts.alive) == held.batch
    first, second = (
        learning.critic_loss(held, agent, batch, Played(rollouts.tracks, rollouts.alive & rows), random.key(3))[0]
        for rows in (jnp.arange(held.batch) < held.batch // 2, jnp.arange(held.batch) >= held.batch // 2)
    )
    both = learning.critic_loss(held, agent, batch, rollouts, random.key(3))[0]
    assert both == pytest.approx(float(first + second) / 2, rel=1e-5) and abs(float(first - second)) > 1e-6


class Reconstructing(DoubleGoal):
    """Plays the encoder's branch for L_rec, as driving does."""

    reconstructs_rollouts = True

    def discrepancy(self, demonstration, trajectory):
        return jnp.mean((demonstration.trajectory.states.qpos - trajectory.states.qpos) ** 2)


@pytest.mark.parametrize("scene", [SCENE, Reconstructing(steps=SCENE.steps)], ids=["actions", "rollouts"])
@pytest.mark.parametrize("method", CLOSED_LOOP)
def test_only_rollouts_under_types_as_at_test_time_are_fakes_where_told_so(method, scene):
    """Of RTC, its prior branch: neither L_adv nor the discriminator reads the other one, which is played for L_rec alone."""
    told = learner(method, weights=LossWeights(adversarial_ramp=0, fakes="test"), share=0.25)
    held = dataclasses.replace(told, scene=scene, weights=dataclasses.replace(told.weights, fakes="all"))
    told = dataclasses.replace(told, scene=scene)
    state, batch = begin(told)
    agent = told.agent(state.networks)
    typed, rollouts = played(held, state.networks, batch, random.key(1), random.key(2))
    rtc, split = method.startswith("rtc"), 3
    assert (told.faking != held.faking) == rtc == ("losses.fakes" not in unread(method))
    if not rtc:
        assert told.closed_loop == held.closed_loop and [told.losses(b) for b in told.closed_loop] == [
            held.losses(b) for b in held.closed_loop
        ]
        return
    fakes = Played(jax.tree.map(lambda x: x[split:], rollouts.tracks), rollouts.alive[split:])
    masked = Played(rollouts.tracks, rollouts.alive & (jnp.arange(told.batch) >= split))
    mine = rollouts if scene.reconstructs_rollouts else fakes
    (ours, _), (theirs, _) = (learning.critic_loss(x, agent, batch, y, random.key(3)) for x, y in ((told, mine), (held, masked)))
    assert float(ours) == pytest.approx(float(theirs), rel=1e-6)
    lost = learning.branch_losses(told, agent, batch, typed, mine, random.key(4), frozenset(LOSSES))
    plain = jax.vmap(lambda case: LOSSES["adversarial"](agent, case, told.weights))(Case(None, None, fakes.tracks, None))
    assert float(lost["adversarial"]) == pytest.approx(float(jnp.mean(plain)), rel=1e-6)
    assert ("reconstruction" in lost) == scene.reconstructs_rollouts
    alone = dataclasses.replace(told, weights=dataclasses.replace(only(adversarial=1.0), fakes="test"))
    gradient, _ = gradients(alone, state.networks, batch, random.key(0), jnp.array(0))
    assert size(gradient.encoder) == 0 and size(gradient.policy) > 0  # types that only L_rec and L_kl shape
    assert sum(told.size(b) for b in told.closed_loop) == told.batch - (0 if scene.reconstructs_rollouts else split)


@pytest.mark.parametrize("kind", "cd")
def test_rtc_with_all_of_the_minibatch_encoded_is_naive_hierarchy_whatever_are_fakes(kind):
    weights = LossWeights(adversarial_ramp=0, fakes="test")
    naive, rtc = learner(f"naive_hierarchy_{kind}", weights=weights), learner(f"rtc_{kind}", weights=weights, share=1.0)
    assert rtc.faking == rtc.method.closed_loop and [rtc.losses(rtc.method.branches[0])] == [naive.losses(b) for b in naive.method.branches]


def test_discriminator_is_kept_smooth_where_experts_are_and_where_agents_are(x64):
    """By the mean squared slope of the logit, over all that is finite; with its derivative by differences."""
    held = learner("rtc_c")
    state, batch = begin(held)
    agent = held.agent(state.networks)
    _, rollouts = played(held, state.networks, batch, random.key(1), random.key(2))
    rollouts = dataclasses.replace(rollouts, alive=rollouts.alive.at[3].set(False))

    def loss(networks, **weights):
        other = dataclasses.replace(held, weights=dataclasses.replace(held.weights, **weights))
        return learning.critic_loss(other, held.agent(networks), batch, rollouts, random.key(3))[0]

    def slopes(tracks):
        slope = jax.grad(lambda x: agent.networks.discriminator(x)[0])
        pairs = agent.pair(tracks.observations[:, :-1], tracks.actions)
        return jnp.sum(jax.vmap(jax.vmap(slope))(pairs) ** 2, axis=-1)

    bare = {"discriminator_penalty": 0.0, "discriminator_penalty_agent": 0.0}
    rest = loss(state.networks, **bare)
    on_experts, on_agents = jnp.mean(slopes(batch.trajectory)), jnp.mean(slopes(rollouts.tracks)[rollouts.alive])
    assert loss(state.networks, **bare | {"discriminator_penalty": 0.5}) - rest == pytest.approx(0.5 * float(on_experts), rel=1e-9)
    assert loss(state.networks, **bare | {"discriminator_penalty_agent": 0.5}) - rest == pytest.approx(0.5 * float(on_agents), rel=1e-9)
    check_grads(lambda n: loss(n, discriminator_penalty_agent=0.5), (state.networks,), order=1, modes=("rev",), eps=1e-6)


@pytest.mark.parametrize("method", ["rtc_c", "rtc_d"])
def test_encoder_gets_no_gradient_from_the_prior_branch(method):
    held = learner(method, weights=only(adversarial=1.0), share=0.0)
    state, batch = begin(held)
    gradient, _ = gradients(held, state.networks, batch, random.key(0), jnp.array(0))
    assert size(gradient.encoder) == 0 and size(gradient.policy) > 0


@pytest.mark.parametrize("method", CLOSED_LOOP)
def test_discriminator_gets_no_gradient_from_what_the_policy_loses(method):
    held = learner(method)
    state, batch = begin(held)
    _, rollouts = played(held, state.networks, batch, random.key(1), random.key(2))

    def lost(networks):
        agent = held.agent(networks)
        typed = learning.infer(held, agent, batch, random.key(1))
        return sum(learning.branch_losses(held, agent, batch, typed, rollouts, random.key(3), frozenset(LOSSES)).values())

    assert size(jax.jit(jax.grad(lost))(state.networks).discriminator) == 0


@pytest.mark.parametrize("method", [name for name in CLOSED_LOOP if name not in SCORED])
def test_a_step_down_the_adversarial_loss_raises_the_experts_probability(method, x64):
    held = learner(method, weights=only(adversarial=1.0))
    state, batch = begin(held)
    gradient, _ = gradients(held, state.networks, batch, random.key(0), jnp.array(0))

    def probability(networks):
        agent = held.agent(dataclasses.replace(networks, discriminator=state.networks.discriminator))
        types, play, _, _ = random.split(random.key(0), 4)
        tracks = played(held, agent.networks, batch, types, play)[1].tracks
        return float(jnp.mean(jax.nn.sigmoid(jax.vmap(agent.logit)(tracks.observations[:, :-1], tracks.actions))))

    stepped = jax.tree.map(lambda x, g: x - 0.05 * g / (1e-9 + size(gradient.policy)), state.networks, gradient)
    assert probability(stepped) > probability(state.networks)


@pytest.mark.parametrize("kind", ["c", "d"])
def test_rtc_with_share_one_is_naive_hierarchy(kind):
    states = []
    for name in (f"rtc_{kind}", f"naive_hierarchy_{kind}"):
        held = learner(name, share=1.0)
        state, _ = begin(held)
        step = jax.jit(functools.partial(train_step, held))
        for _ in range(2):
            state, _ = step(state, experts(False))
        states.append(jax.tree.leaves(state.networks))
    assert all(np.array_equal(a, b) for a, b in zip(*states, strict=True))


def test_no_loss_of_the_policy_reads_the_experts_inner_truth():
    """With the truth taken away an update is the same: nothing learns from it."""
    held = learner("rtc_c")
    state, _ = begin(held)
    whole = experts(False)
    blind = dataclasses.replace(whole, truth=())
    a, b = (jax.jit(functools.partial(train_step, held))(state, data)[0] for data in (whole, blind))
    assert all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a.networks), jax.tree.leaves(b.networks), strict=True))


@pytest.mark.parametrize("method", ENCODING)
def test_encoder_reads_the_whole_trajectory(method):
    held = learner(method)
    state, batch = begin(held)
    one = jax.tree.map(lambda x: x[0], batch)

    def code(trajectory):
        return sum(jnp.sum(x**2) for x in jax.tree.leaves(held.agent(state.networks).posterior(trajectory)))

    slope = jax.grad(code)(one.trajectory)
    assert np.all(np.abs(slope.observations).sum(axis=1) > 0) and np.all(np.abs(slope.actions).sum(axis=1) > 0)


@pytest.mark.parametrize("method", CLOSED_LOOP)
def test_discriminator_never_sees_the_type(method):
    """Its input is state and action, whatever the method's types."""
    held = learner(method)
    state, batch = begin(held)
    first = state.networks.discriminator.head.layers[0].kernel
    assert first.shape[0] == batch.trajectory.observations.shape[-1] + batch.trajectory.actions.shape[-1]


@pytest.mark.parametrize("method", ENCODING)
def test_recovery_of_types_is_of_what_the_prior_drew(method):
    """Policy and encoder lower it, the prior does not; it is of RTC's prior branch, and left out where it weighs nothing."""
    held = learner(method, weights=only(type_recovery=1.0, type_recovery_ramp=0))
    state, batch = begin(held)
    gradient, report = gradients(held, state.networks, batch, random.key(0), jnp.array(0))
    if not method.startswith("rtc"):
        assert "type_recovery" not in report and {"losses.type_recovery", "losses.type_recovery_ramp"} <= unread(method)
        return
    types, play, *_ = random.split(random.key(0), 4)
    typed, rollouts = played(held, state.networks, batch, types, play)
    drawn, first = typed[1].agent_type, held.size(held.method.branches[0]) * (len(held.closed_loop) == 2)
    tracks = jax.tree.map(lambda x: x[first:], rollouts.tracks)
    told = jax.vmap(lambda track, g: held.agent(state.networks).posterior(track).log_prob(g))(tracks, drawn)
    assert report["type_recovery"] == pytest.approx(-float(jnp.mean(told)), rel=1e-5)
    assert size(gradient.policy) > 0 and size(gradient.encoder) > 0 and size(gradient.prior) == 0
    without = learner(method)
    assert "type_recovery" not in gradients(without, state.networks, batch, random.key(0), jnp.array(0))[1]


def test_info_mgail_trains_its_inference_on_the_same_term():
    held = learner("info_mgail_d", weights=only(type_info=1.0))
    state, batch = begin(held)
    gradient, _ = gradients(held, state.networks, batch, random.key(0), jnp.array(0))
    assert size(gradient.inference) > 0 and size(gradient.policy) > 0


def test_info_mgail_clones_under_the_type_that_q_infers():
    """Where Q knows the type, cloning is conditioned on it."""
    held = learner("info_mgail_d")
    state, batch = begin(held)
    one = jax.tree.map(lambda x: x[0], batch)
    sure = jax.tree.map(jnp.zeros_like, state.networks.inference)
    sure.head.layers[-1].bias = type(sure.head.layers[-1].bias)(jnp.array([0.0, 0.0, 5.0, 0.0]))
    agent = held.agent(dataclasses.replace(state.networks, inference=sure))
    drawn = [SOURCES["inference"](agent, one, k).agent_type for k in random.split(random.key(0), 50)]
    assert np.mean([g[2] for g in drawn]) > 0.95


@pytest.mark.parametrize("mode", ["full", "dynamics_only", "none"])
def test_gradient_modes_and_decay_change_no_value(mode):
    held = learner("mgail")
    state, batch = begin(held)
    agent, one = held.agent(state.networks), jax.tree.map(lambda x: x[0], batch)
    actor = agent.actor(jnp.zeros(0), random.key(0), jnp.zeros((SCENE.steps, agent.outputs)))
    plain = rollout(SCENE, actor, one.episode)
    other = rollout(SCENE, actor, one.episode, gradient=mode, decay=0.8)
    assert all(np.allclose(a, b, atol=1e-6) for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(other), strict=True))


def test_gradient_modes_cut_what_they_say(x64):
    """By how the last position follows the first action: fully, by physics alone (v' = damped v), by decay to the power of steps."""
    held = learner("mgail")
    state, batch = begin(held)
    agent, one = held.agent(state.networks), jax.tree.map(lambda x: x[0], batch)

    def slope(**options):
        def last(nudge):
            return rollout(SCENE, agent.actor(jnp.zeros(0), random.key(0), nudge), one.episode, **options).states.qpos[-1, 0]

        return np.asarray(jax.jit(jax.grad(last))(jnp.zeros((SCENE.steps, agent.outputs))))

    full, physics, nothing = (slope(gradient=mode) for mode in ("full", "dynamics_only", "none"))
    assert np.abs(nothing[:-1]).max() == 0 and np.abs(nothing[-1]).max() > 0
    assert np.abs(full[0] - physics[0]).max() > 1e-6
    decayed = slope(gradient="dynamics_only", decay=0.5)
    steps_after = np.arange(SCENE.steps)[::-1]
    assert np.allclose(decayed, physics * 0.5 ** steps_after[:, None])


def test_a_trajectory_that_is_not_finite_is_dropped_and_counted():
    gradient = jnp.ones((4, 3, 2)).at[1, 0, 0].set(jnp.nan)
    kept, report = learning.guard(gradient, jnp.array([True, True, False, True]), np.array([1, 3, 3, 3]), largest=1.0)
    assert report["trajectories_dropped"] == 2 and np.all(np.isfinite(kept))
    assert np.all(kept[1:3] == 0) and np.all(kept[0] > 0)
    lengths = np.linalg.norm(np.asarray(kept), axis=(1, 2))
    assert np.allclose(lengths[[0, 3]] * [1, 3], 1.0)  # clipped: the norms of their own losses were sqrt(6) and 3 sqrt(6)


@pytest.mark.parametrize("method", ["mgail", "gail"])
def test_a_rollout_that_is_not_finite_does_not_spoil_an_update(method):
    held = learner(method)
    state, batch = begin(held)
    sick = dataclasses.replace(batch.episode.start, qvel=batch.episode.start.qvel.at[2].set(jnp.inf))
    batch = dataclasses.replace(batch, episode=dataclasses.replace(batch.episode, start=sick))
    gradient, report = gradients(held, state.networks, batch, random.key(0), jnp.array(0))
    assert report["trajectories_dropped"] == 1
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((gradient, report)))


@pytest.mark.parametrize("name", ["adversarial", "type_kl"])
def test_weights_ramp_linearly(name):
    weights = only(**{name: 2.0, f"{name}_ramp": 10})
    at = [float(weights.total({name: jnp.array(1.0)}, jnp.array(update))) for update in (0, 4, 9, 50)]
    assert np.allclose(at, [0.2, 1.0, 2.0, 2.0])


def test_lambda_waits_for_its_start():
    weights = only(adversarial=2.0, adversarial_ramp=10, adversarial_start=5)
    at = [float(weights.total({"adversarial": jnp.array(1.0)}, jnp.array(update))) for update in (0, 4, 5, 9, 14, 50)]
    assert np.allclose(at, [0, 0, 0.2, 1.0, 2.0, 2.0])


def test_every_loss_is_used_and_every_used_loss_is_known():
    used = {loss for method in METHODS.values() for branch in method.branches for loss in branch.losses}
    assert used == set(LOSSES) and used <= {f.name for f in dataclasses.fields(LossWeights)}
    assert {branch.types for method in METHODS.values() for branch in method.branches} <= set(SOURCES)


def test_cloning_loss_by_hand():
    """One component at zero with unit control scale: -log density is known."""
    held = learner("bc")
    state, batch = begin(held)
    zero = jax.tree.map(jnp.zeros_like, state.networks.policy)
    agent = held.agent(Networks(zero, None, None, None, None))
    one = jax.tree.map(lambda x: x[0], batch)
    typed = SOURCES["none"](agent, one, random.key(0))
    lost = LOSSES["cloning"](agent, Case(one, typed, None, random.key(0)), held.weights)
    scale = held.model.smallest_scale + np.log(2)
    actions = np.asarray(one.trajectory.actions, float)
    assert float(lost) == pytest.approx(
        np.mean(np.sum(0.5 * (actions / scale) ** 2 + np.log(scale) + 0.5 * np.log(2 * np.pi), axis=1)), rel=1e-5
    )


def test_networks_do_not_care_in_which_order_items_come():
    layout = Layout(3, (ItemSet("first", 4, 5), ItemSet("second", 2, 3)), 2)
    x = random.normal(random.key(0), (3 + 20 + 6 + 2,))
    x = x.at[jnp.array([3, 8, 13, 23])].set(1.0).at[jnp.array([18, 26])].set(0.0)  # three items there in the first set, one in the second
    items = x[3:23].reshape(4, 5)
    turned = x.at[3:23].set(items[jnp.array([2, 0, 3, 1])].reshape(-1))
    for network in (Reader(layout, [8, 8], 6, nnx.Rngs(0)), Encoder(layout, 6, 8, 2, nnx.Rngs(0))):
        read = jax.jit((lambda v, n=network: n(v[None])) if isinstance(network, Encoder) else network.__call__)
        assert np.allclose(read(x), read(turned), atol=1e-6)
        assert not np.allclose(read(x), read(x.at[4].add(1.0)), atol=1e-4)
    scores = Scores(layout, 8, nnx.Rngs(0))
    assert np.allclose(scores(x)[jnp.array([2, 0, 3, 1])], scores(turned), atol=1e-6) and scores(x)[3] < -20


def test_a_set_without_items_says_nothing():
    layout = Layout(1, (ItemSet("only", 2, 3),), 0)
    empty = jnp.zeros(7).at[0].set(0.3)
    network = Reader(layout, [8], 2, nnx.Rngs(0))
    assert np.all(np.isfinite(jax.grad(lambda v: jnp.sum(network(v)))(empty)))
    assert np.all(np.isfinite(network(empty))) and not np.allclose(network(empty), network(empty.at[4].set(1.0)))
