"""The study: claims and comparisons by hand, studies that are stopped and go on."""

import functools
import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from learning import SCENE

from rtc_mjx import claims, dataset, evaluate, study, train
from rtc_mjx.errors import RunError, UsageError
from rtc_mjx.methods import METHODS
from rtc_mjx.scenes import SCENES

SMALL = [
    "--scene.steps", str(SCENE.steps), "--updates", "4", "--batch", "8", "--experts.train", "64", "--experts.test", "32",
    "--every.log", "2", "--every.test", "4", "--every.save", "2", "--model.width", "8", "--model.discriminator-width", "8",
]  # fmt: skip


def run_with(tmp_path, name, **metrics):
    """A stand-in for a run: an evaluation, and what the tables read of its settings."""
    folder = tmp_path / name
    folder.mkdir()
    types = {source: {metric: {"per_seed": values} for metric, values in of.items()} for source, of in metrics.items()}
    seeds = len(next(iter(metrics["prior"].values())))
    result = {
        "metrics": types["prior"],
        "types": types,
        "reference": {},
        "update": 1,
        "seeds": seeds,
        "episodes": 4,
        "asked": 4,
        "commit": None,
    }
    (folder / "evaluation.json").write_text(json.dumps(result))
    return SimpleNamespace(folder=folder, config=SimpleNamespace(scene=SimpleNamespace(main_metrics=("return",)), method=name))


def test_claims_say_what_was_measured_and_whether_it_holds(tmp_path):
    held = {
        "bc": {"prior": {"return": [20.0, 20.0, 20.0], "jsd_goal": [0.0] * 3}},
        "mgail": {"prior": {"return": [30.0, 31.0, 32.0], "jsd_goal": [0.1] * 3}},
        "rtc_c": {
            "prior": {"return": [29.0, 31.0, 30.0], "jsd_goal": [0.001] * 3},
            "paired": {"return": [40.0] * 3, "jsd_goal": [0.0] * 3},
        },
    }
    runs = {name: run_with(tmp_path, name, **types) for name, types in held.items()}
    rows = {line.split("|")[1].strip(): line for line in claims.claims("double_goal", runs).splitlines()[2:]}
    assert len(rows) == 4  # not those of methods that were not run, nor of another scene
    assert rows["MGAIL reaches a higher return than BC"].endswith("| yes |")
    assert "30 >= 1 x 31" in rows["RTC returns at least what MGAIL does"]
    assert rows["RTC returns at least what MGAIL does"].endswith("| no, within the noise |")
    assert next(line for claim, line in rows.items() if "quarter" in claim).endswith("| yes |")
    assert next(line for claim, line in rows.items() if "90 %" in claim).endswith("| no |")
    assert claims.claims("roundabout", runs) == ""


@functools.cache
def metrics_of(name):
    """Names of a scene's metrics, from features of the right shapes."""
    scene = SCENES[name]()

    def one(key):
        held = dataset.demonstrate(scene, key)
        return scene.features(held, held.trajectory)

    features = {k: np.zeros((4, *x.shape), x.dtype) for k, x in jax.eval_shape(one, jax.random.key(0)).items()}
    return set(scene.metrics({k: x[None] for k, x in features.items()}, features))


def test_every_claim_names_metrics_that_its_scene_has():
    for claim in claims.CLAIMS:
        assert claim.scene in SCENES and claim.relation in ("<=", ">=")
        for method, source, metric in (claim.left, claim.right):
            assert method in METHODS and source in ("prior", "paired", "shuffled") and metric in metrics_of(claim.scene)


def test_seeds_are_compared_in_pairs(tmp_path):
    assert claims.sign_flip(np.array([1.0, 2.0, 3.0])) == pytest.approx(2 / 8)
    assert claims.sign_flip(np.array([1.0, -1.0])) == pytest.approx(1.0)
    runs = {
        "mgail": run_with(tmp_path, "mgail", prior={"return": [1.0, 2.0, 3.0]}),
        "rtc_c": run_with(tmp_path, "rtc_c", prior={"return": [2.0, 4.0, 6.0]}),
    }
    text = claims.comparisons(runs)
    assert "| rtc_c | return | +2 | [+1, +3] | 0.25 |" in text and "| mgail | return" not in text
    assert claims.comparisons({"rtc_c": runs["rtc_c"]}) == ""


def test_a_study_that_was_stopped_ends_like_one_that_was_not(tmp_path, monkeypatch):
    def begin(place, methods):
        study.main([
            "--scene", "double_goal", "--methods", methods, "--seeds", "2",
            "--results", str(tmp_path / place), "--runs", str(tmp_path / place / "runs"), *SMALL,
        ])  # fmt: skip

    begin("whole", "bc,mgail")
    with monkeypatch.context() as patched:
        patched.setattr(evaluate, "main", lambda argv: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            begin("stopped", "bc,mgail")  # after the training of bc, before its evaluation
    (tmp_path / "stopped" / "runs" / "double_goal" / "mgail").mkdir()  # stopped before its settings were written
    begin("stopped", "bc,mgail")
    for name in ("bc.json", "mgail.json"):
        whole, stopped = (json.loads((tmp_path / p / "double_goal" / name).read_text()) for p in ("whole", "stopped"))
        assert whole["metrics"] == stopped["metrics"] and whole["types"] == stopped["types"]
    assert (tmp_path / "whole/double_goal/table.md").read_text() == (tmp_path / "stopped/double_goal/table.md").read_text()
    assert (tmp_path / "whole/double_goal/curves.png").is_file()
    assert (tmp_path / "whole/double_goal/overview.png").is_file()
    monkeypatch.setattr(train, "train", lambda *_: pytest.fail("what is finished was trained again"))
    monkeypatch.setattr(evaluate, "main", lambda argv: pytest.fail("what is finished was evaluated again"))
    begin("whole", "bc,mgail")
    with pytest.raises(UsageError, match=r"--seeds 3.*has 2"):
        study.main(["--scene", "double_goal", "--methods", "bc", "--seeds", "3", "--results", str(tmp_path / "whole"),
                    "--runs", str(tmp_path / "whole/runs"), *SMALL])  # fmt: skip


def test_one_training_that_diverges_does_not_stop_the_others(tmp_path, monkeypatch):
    really = study.complete

    def complete(entry, scene, folder, team):
        if entry.name == "bc":
            raise RunError("update 2: reconstruction of seed 0 is not finite")
        return really(entry, scene, folder, team)

    monkeypatch.setattr(study, "complete", complete)
    out = tmp_path / "few"
    out.mkdir()
    (out / "claims.md").write_text("of other runs")
    with pytest.raises(RunError, match="bc failed: update 2"):
        study.main(["--scene", "double_goal", "--name", "few", "--methods", "bc,mgail", "--seeds", "1",
                    "--results", str(tmp_path), "--runs", str(tmp_path / "r"), *SMALL])  # fmt: skip
    assert (out / "mgail.json").is_file() and not (out / "bc.json").is_file() and not (out / "claims.md").is_file()
    run = study.Run.open(tmp_path / "r" / "few" / "mgail")
    assert study._evaluated(run)
    evaluate.main(["--run", str(run.folder), "--episodes", "8"])  # somebody looks at fewer episodes: not the study's evaluation
    assert not study._evaluated(run)


def test_a_study_is_named_by_a_name(tmp_path):
    with pytest.raises(UsageError, match=r"--name a/b: a name"):
        study.main(["--scene", "double_goal", "--name", "a/b", "--results", str(tmp_path)])


def test_variations_start_from_the_options_given():
    held = study.entries("double_goal", ["rtc_c"], True, ["--losses.adversarial", "3.0"])
    varied = [e.name for e in held if "adversarial" in e.name]
    assert "rtc_c,losses.adversarial=3.0" not in varied and "rtc_c,losses.adversarial=1.0" in varied


def test_variations_change_one_thing_each_and_are_settings_that_exist():
    held = study.entries("double_goal", ["rtc_c"], True, [])
    assert len({entry.name for entry in held}) == len(held) > 10
    for entry in held:
        study.config.from_command_line(["--scene", "double_goal", "--method", entry.method, *entry.options], "study")
    assert all(len(entry.options) == 2 for entry in held[1:])


def test_a_folder_in_the_way_is_left_alone(tmp_path):
    place = tmp_path / "double_goal" / "bc"
    place.mkdir(parents=True)
    (place / "thesis.txt").write_text("years of work")
    with pytest.raises(UsageError, match="in the way"):
        study.complete(study.Entry("bc", "bc"), "double_goal", place)
    assert (place / "thesis.txt").is_file()
