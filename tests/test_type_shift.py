"""What types carry: probes, conditional realism by hand, agents made by hand whose types hold luck or mind, runs end to end."""

import dataclasses
import json
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from learning import SCENE, learner, settings
from made import recordings
from matplotlib.figure import Figure

from rtc_mjx import carried, config, dataset, evaluate, probe, shift_report, type_shift
from rtc_mjx.agent_types import Continuous
from rtc_mjx.distributions import Gaussian
from rtc_mjx.errors import UsageError
from rtc_mjx.learner import Learner
from rtc_mjx.methods import METHODS
from rtc_mjx.probe import ProbeOptions, information, noisy_copy
from rtc_mjx.realism import BINS, Bins, compared
from rtc_mjx.runs import Run
from rtc_mjx.scenes import Actor, DoubleGoal
from rtc_mjx.trained import Trained
from rtc_mjx.updates import start_all

QUICK = ProbeOptions(updates=150, learning_rate=3e-3, null=3)


# Probes


def test_a_probe_finds_the_bits_that_are_shared_and_none_where_there_are_none():
    random = np.random.default_rng(0)
    x = random.standard_normal((1024, 2))
    noisy = 0.9 * x[:, :1] + np.sqrt(1 - 0.81) * random.standard_normal((1024, 1))
    bits, null = information(x, noisy, QUICK)
    assert 0.75 * 1.198 < bits < 1.05 * 1.198  # -log2(1 - 0.9^2) / 2
    assert np.max(np.abs(null)) < 0.1
    bit, _ = information(x, np.sign(x[:, :1]), QUICK)
    assert 0.85 < bit < 1.02
    nothing, null = information(x, random.standard_normal((1024, 3)), QUICK)
    assert nothing < np.max(null) + 0.05


def test_a_noisy_copy_tells_what_it_says():
    """Of one Gaussian number: exactly the bits asked for; of several functions of one another, less."""
    x = np.random.default_rng(1).standard_normal((20000, 1))
    copy, most = noisy_copy(x, 1, 2.0)
    correlation = np.corrcoef(copy[:, 0], x[:, 0])[0, 1]
    assert most == pytest.approx(2.0, abs=0.01) and -np.log2(1 - correlation**2) / 2 == pytest.approx(2.0, abs=0.05)
    assert noisy_copy(x, 4, 2.0)[1] < 1.5  # all four copy the same number


def test_a_probe_has_power_against_as_many_numbers_as_driving_has():
    random = np.random.default_rng(2)
    hidden = random.standard_normal((4096, 8))
    luck = hidden @ random.standard_normal((8, 138)) + 0.5 * random.standard_normal((4096, 138))
    copy, most = noisy_copy(luck, 8, 1.0)
    bits, null = information(copy, luck, dataclasses.replace(QUICK, learning_rate=1e-3, null=1))
    assert 0.4 < bits < most + 0.05 and np.max(null) < 0.05


@pytest.mark.parametrize("groups", [16, 33, 100])
def test_agents_of_one_episode_are_on_one_side_of_a_probe(groups):
    rows = np.arange(groups * 3)
    sides = [{int(row) // 3 for row in rows[part]} for part in probe.parts(groups, 3)]
    assert sum(map(len, sides)) == groups == len(set.union(*sides)) and min(map(len, sides)) >= groups // 4


# Conditional realism


def test_conditional_realism_by_hand():
    """Two episodes, two experts and as many again for the floor; the second of two agents does what no expert does in one episode."""
    theirs = np.array([[1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 1.0, 0.0]])
    ours = np.array([[[1.0, 0.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 1.0]]])  # (agents, rollouts, episodes)
    found = compared(ours, theirs, Bins(0.0, 1.0))
    assert found["agent"] == [0.0, 0.5] and found["floor"] == 0.0 and found["range"] == [0.0, 1.0]
    assert found["interval"] == [0.0, 0.5] and found["floor_interval"] == [0.0, 0.0]  # of the mean over seeds: 0.5 and 0 by episode
    along = compared(np.zeros((1, 2, 3, 5)), np.zeros((3, 4, 5)), Bins(0.0, 0.0))  # a feature with a value at each of five times
    assert along["agent"] == [0.0] and along["floor"] == 0.0


def test_experts_who_all_do_the_same_tell_one_who_does_not():
    for off in (-1.0, -1e-9, 1e-9, 5.0):
        assert compared(np.full((1, 2, 2), off), np.zeros((2, 4)), Bins(0.0, 0.0))["agent"] == [1.0]


@pytest.mark.parametrize("seed", range(8))
def test_one_outlier_never_lowers_the_divergence(seed):
    random = np.random.default_rng(seed)
    theirs, ours = random.normal(0, 1, (4, 24)), random.normal(random.normal(), 1, (1, 12, 4))
    bins = Bins.of(theirs)
    before = compared(ours, theirs, bins)
    for size in (-1e3, 10.0, 1e6):
        odd = ours.copy()
        odd[0, random.integers(12), random.integers(4)] = size
        after = compared(odd, theirs, bins)
        assert after["agent"][0] >= before["agent"][0] - 1e-12
        assert (after["floor"], after["range"]) == (before["floor"], before["range"])


def test_the_interval_is_over_episodes_and_agents_of_one_are_one():
    theirs = np.zeros((6, 4))
    ours = np.zeros((1, 2, 6))
    ours[..., 3:] = 1.0  # of three episodes with two agents: 0, 0.5, 1
    low, high = compared(ours, theirs, Bins(0.0, 1.0), agents=2)["interval"]
    assert (low, high) == (0.0, 1.0)
    alone = compared(ours, theirs, Bins(0.0, 1.0))["interval"]
    assert 0.0 < alone[0] < 0.5 < alone[1] < 1.0


def test_bins_hold_what_experts_do_and_have_two_for_the_rest():
    bins = Bins.of(np.array([[2.0]]), np.array([0.0, 1.0]))
    assert list(bins.index(np.array([-0.1, 0.0, 1.999, 2.0, 2.1]))) == [0, 1, BINS, BINS, BINS + 1]


# Agents made by hand


@dataclass(frozen=True)
class Copier:
    """An agent whose type is what `copy` reads off a trajectory; it heads for where `aim` (type, observation) says."""

    copy: Any
    aim: Any
    size: int
    scene: DoubleGoal

    @property
    def space(self):
        return Continuous(self.size, 1)

    def posterior(self, track):
        return Gaussian(self.copy(track), jnp.full(self.size, 0.05))

    def prior(self, observation):
        return Gaussian(jnp.zeros(self.size), jnp.ones(self.size))

    def actor(self, agent_type, key, nudge):
        def act(g, memory, seen, noise):
            away = self.aim(g, seen) - seen[:2]
            return memory, jnp.clip(3.0 * away - 0.8 * seen[2:4], -1, 1)

        return Actor((), Partial(act, agent_type), jnp.zeros(self.scene.steps))


def luck_of(track):
    return track.observations[-1, 4:6]  # where the lower goal is at last


def mind_of(track):
    return jnp.sign(track.observations[-1, 1:2])  # which side was wanted


@dataclass(frozen=True)
class HandMade(Learner):
    """A learner whose agent is given."""

    copier: Any = None

    def agent(self, networks):
        return self.copier


def hand_made(copier):
    base = dataclasses.replace(learner("rtc_c"), scene=copier.scene)
    held = HandMade(**{f.name: getattr(base, f.name) for f in dataclasses.fields(base)}, copier=copier)
    return Trained(dataclasses.replace(settings("rtc_c"), scene=copier.scene), held, jnp.zeros(1), 0)


WHOLE = DoubleGoal()
COPIERS = {
    "luck": Copier(luck_of, lambda g, seen: g, 2, WHOLE),
    "mind": Copier(mind_of, lambda g, seen: jnp.where(g[0] > 0, seen[6:8], seen[4:6]), 1, WHOLE),
}


@pytest.fixture(scope="module")
def told():
    """Of both agents what their types tell, how they show, and what rollouts are worth by source of types."""
    test = dataset.demonstrations(WHOLE, 512, dataset.TEST)
    shown = dataset.without_truth(test)
    few, options = jax.tree.map(lambda x: x[:32], shown), dataclasses.replace(QUICK, batch=128, null=2)
    out = {}
    for name, copier in COPIERS.items():
        held = hand_made(copier)
        out[name] = carried.told_by_types(held, shown, test.truth, options) | type_shift.of_types(held, few, iter)
    return out


def test_types_that_copy_luck_tell_of_it_and_types_that_copy_the_mind_do_not(told):
    luck, mind = (told[name]["information"] for name in ("luck", "mind"))
    assert luck["xi"]["bits"][0] > 2 and luck["xi"]["bits"][0] > 10 * max(0.1, luck["xi"]["null_95"])
    assert mind["xi"]["bits"][0] < mind["xi"]["null_95"] + 0.1
    assert mind["mind"]["bits"][0] > 0.5 and luck["mind"]["bits"][0] < luck["mind"]["null_95"] + 0.1
    assert np.shape(luck["xi"]["null"]) == (1, 2)  # a null for each seed
    assert told["luck"]["probe"]["episodes"] == 512 and 0.3 < told["luck"]["probe"]["control"]["bits"] < 1.05


def test_types_that_copy_luck_do_not_show_in_another_episode_and_types_that_copy_the_mind_do(told):
    luck, mind = (told[name]["reencoding"] for name in ("luck", "mind"))
    assert luck["demonstration"][0] - luck["rollout_elsewhere"][0] > 20
    assert abs(luck["demonstration"][0] - luck["rollout"][0]) < 1  # xi is the same: so is the type
    assert mind["demonstration"][0] > 2 and abs(mind["demonstration"][0] - mind["rollout_elsewhere"][0]) < 1


def test_only_types_that_copy_luck_lose_when_shuffled(told):
    luck, mind = (told[name]["types"] for name in ("luck", "mind"))
    values = {source: of["return"][0] for source, of in luck.items()}
    assert values["paired"] > 4 * values["shuffled"] and values["same_xi"] > 0.9 * values["paired"]
    assert abs(mind["paired"]["return"][0] - mind["shuffled"]["return"][0]) < 0.1 * mind["paired"]["return"][0]


def test_only_an_agent_without_luck_in_its_type_reacts_to_luck_turned_round_as_its_expert_does(told):
    luck, mind = (told[name]["reaction"] for name in ("luck", "mind"))
    assert mind["paired"]["like_expert"][0] > 0.8 > 0.4 > luck["paired"]["like_expert"][0]
    assert luck["paired"]["as_it_was"][0] > 0.8 and all(len(values) == 1 for of in mind.values() for values in of.values())


# Runs


def untrained(folder, *options, scene="double_goal", method="rtc_d", data=()):
    """A run as it stands before its first update."""
    small = ("--batch", "8", "--experts.train", "32", "--experts.test", "16", "--model.width", "8", "--model.discriminator-width", "8")
    held = config.from_command_line(["--scene", scene, "--method", method, "--run", str(folder), *small, *options, *data], "test")
    run = Run.create(held)
    stand = held.learner(dataset.statistics(held.scene, dataset.demonstrations(held.scene, held.experts.train, dataset.TRAIN)))
    run.save(0, start_all(stand, held.all_seeds), 0.0)
    return run


@pytest.fixture
def quick_probe(monkeypatch):
    monkeypatch.setattr(type_shift, "PROBE", ProbeOptions(updates=25, null=2))


def analysed(run, *options):
    type_shift.main(["--run", str(run.folder), "--experts", "2", "--probe", "16", *options])
    assert (run.folder / "media" / "type_shift.png").read_bytes().startswith(b"\x89PNG")
    return json.loads((run.folder / type_shift.FILE).read_text())


def check_types(result, agents, metric):
    """What holds of every run whose types are read off trajectories."""
    parts = [of for of in result["by_luck"].values() if of["agents"]]
    assert sum(of["agents"] for of in parts) == agents and all(metric in of for of in parts)
    assert set(result["reencoding"]) == {"demonstration", "rollout", "rollout_elsewhere"}
    assert all(np.all(np.isfinite(bits)) for bits in result["reencoding"].values())
    assert {"prior", "paired", "shuffled"} <= set(result["types"])


@pytest.mark.usefixtures("quick_probe")
@pytest.mark.parametrize("method", ["rtc_d", "info_mgail_c", "bc"])
def test_the_analysis_of_types_says_what_is_there_to_say(method, tmp_path):
    run = untrained(tmp_path / "run", "--scene.steps", str(SCENE.steps), "--seeds", "2", method=method)
    result = analysed(run, "--episodes", "32")
    assert set(result["realism"]["features"]) == set(SCENE.described_by)
    assert all(len(of["agent"]) == 2 and 0 <= of["floor"] <= 1 for of in result["realism"]["features"].values())
    assert {name: result[name] for name in ("update", "episodes", "asked", "experts", "probed")} == {
        "update": 0, "episodes": 32, "asked": 32, "experts": 2, "probed": 16,
    }  # fmt: skip
    if method == "bc":
        assert "types" not in result and "types" in result["left_out"]
        return
    check_types(result, 32, "return")
    assert set(result["types"]) == {"prior", "paired", "same_xi", "shuffled"} and set(result["information"]) == {"xi", "mind"}
    assert set(result["reaction"]) == {"prior", "paired", "shuffled", "expert"}
    assert len(result["reaction"]["paired"]["like_expert"]) == 2 and len(result["reaction"]["expert"]["flipped"]) == 1
    parts = [of for of in result["by_luck"].values() if of["agents"]]
    whole = sum(of["agents"] * of["return"][0] for of in parts) / 32
    assert whole == pytest.approx(result["types"]["shuffled"]["return"][0])
    with pytest.raises(UsageError, match="--probe 8"):
        type_shift.main(["--run", str(run.folder), "--probe", "8"])
    with pytest.raises(UsageError, match="--episodes 3"):
        type_shift.main(["--run", str(run.folder), "--episodes", "3"])


@pytest.mark.usefixtures("quick_probe")
@pytest.mark.parametrize(("scene", "cars"), [("intersection", 2), ("womd", 1)])
def test_the_analysis_of_types_on_driving(scene, cars, tmp_path):
    """Several agents of an episode are agents each; recordings have one expert to an episode, and no signals that could be turned round."""
    data = ("--scene.data", recordings("scenarionet_waymo")) if scene == "womd" else ("--scene.controlled", str(cars))
    run = untrained(tmp_path / "run", "--scene.steps", "4", "--scene.road-users", "1", scene=scene, method="rtc_c", data=data)
    result = analysed(run, "--episodes", "16")
    check_types(result, cars * result["episodes"], "collision_rate")
    drawn_again = scene != "womd"
    assert ("realism" in result) == drawn_again == ("same_xi" in result["types"]) == ("reaction" in result)
    assert set(result["left_out"]) >= (set() if drawn_again else {"realism"})
    if drawn_again:
        assert set(result["realism"]["features"]) == set(run.config.scene.described_by) and set(result["information"]) == {"xi", "mind"}


def test_a_figure_holds_several_runs_and_leaves_out_what_none_has():
    one = {"metric": "return", "types": {"prior": {"return": [1.0, 2.0]}}, "reencoding": {"rollout": [1.0]}}
    canvas = Figure()
    shift_report.draw(canvas, {"a": one, "b": {"metric": "return", "types": {"prior": {"return": [3.0]}, "paired": {"return": [4.0]}}}})
    shown = [axis for axis in canvas.axes if axis.axison]
    assert [axis.get_title() for axis in shown] == ["return, by source of types", "trajectory shows its type, bits"]
    assert [text.get_text() for text in shown[0].get_legend().get_texts()] == ["a", "b"]
    markers = {line.get_marker() for line in shown[0].lines}
    assert len(markers) == 2  # told apart without colour
    shift_report.draw(Figure(), {"bc": {"metric": "return"}})


def test_shuffled_types_are_told_apart_in_the_figure_only_where_luck_tells_them_apart():
    yes, no = {"agents": 3, "return": [1.0]}, {"agents": 0, "return": []}
    for other, panels in ((no, 0), (yes, 1)):
        canvas = Figure()
        held = {"metric": "return", "by_luck": {"type yes, episode yes": yes, "type yes, episode no": other}}
        shift_report.draw(canvas, {"run": held})
        assert len(canvas.axes) == panels


def test_types_are_read_off_trajectories_by_whatever_a_method_has():
    test = jax.tree.map(jnp.asarray, dataset.without_truth(dataset.demonstrations(SCENE, 4, dataset.TEST)))
    for method, there in {"rtc_c": True, "info_mgail_d": True, "symphony": True, "mgail": False}.items():
        assert bool(evaluate.donors(SCENE, METHODS[method], test)) is there
