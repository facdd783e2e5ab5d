"""Whole short trainings on a driving scene: a file of its own, because they take as long as many others."""

import pytest

from rtc_mjx import evaluate, train
from rtc_mjx.config import Config, Experts, Intervals
from rtc_mjx.learner import OptimiserOptions
from rtc_mjx.models import ModelOptions
from rtc_mjx.scenes import SCENES


@pytest.mark.parametrize("method", ["rtc_c", "symphony"])
def test_methods_train_on_the_intersection(method, tmp_path):
    """A real, short training: losses by rollouts and by route labels, tests, evaluation with flipped signals."""
    held = Config(
        scene=SCENES["intersection"](steps=6, road_users=3), method=method, updates=2, batch=4, run=tmp_path / "run",
        model=ModelOptions(width=8, discriminator_width=8, mixture=1, type_size=2, prior_components=2),
        optimiser=OptimiserOptions(gradient="dynamics_only"), experts=Experts(train=16, test=4), every=Intervals(log=1, test=2, save=2),
    )  # fmt: skip
    run = train.train(held)
    line = run.metrics()[-1]
    assert line["update"] == 2 and {"collision_rate", "min_ade", "cloning"} <= set(line)
    assert ("reconstruction" in line) is (method == "rtc_c") and ("type_nll" in line) is (method == "symphony")
    assert line["trajectories_dropped"] == [0.0]
    result = evaluate.evaluate(run, 4)
    assert set(result["reaction"]) == {*result["types"], "expert"} and result["reaction"]["expert"]["like_expert"] == 1.0
    assert 0 <= result["metrics"]["collision_rate"]["mean"] <= 1 and set(result["ranges"]) == {"curvature", "progress"}
