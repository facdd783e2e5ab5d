"""The study: verdicts and tests over seeds by hand, studies that are stopped and go on, results that are neither lost nor mixed up."""

import contextlib
import dataclasses
import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from learning import SCENE

from rtc_mjx import (
    charts,
    claims,
    config,
    dataset,
    entry,
    evaluate,
    over_seeds,
    provenance,
    report,
    results,
    study,
    tables,
    train,
    type_shift,
    verdicts,
)
from rtc_mjx.errors import DivergedError, UsageError
from rtc_mjx.methods import METHODS
from rtc_mjx.runs import Run
from rtc_mjx.scenes import SCENES

ROOT = Path(__file__).resolve().parents[1]
SMALL = [
    "--scene.steps", str(SCENE.steps), "--updates", "4", "--batch", "8", "--experts.train", "64", "--experts.test", "32",
    "--every.log", "2", "--every.test", "4", "--every.save", "2", "--model.width", "8", "--model.discriminator-width", "8",
]  # fmt: skip


def command(place, methods, *more, seeds=2):
    return [
        "--scene", "double_goal", "--methods", methods, "--seeds", str(seeds),
        "--results", str(place), "--runs", str(place / "runs"), *SMALL, *more,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A study that was not stopped: its folder of results is double_goal, its runs are in runs/double_goal."""
    place = tmp_path_factory.mktemp("whole")
    study.main(command(place, "bc,mgail"))
    return place


@pytest.fixture
def again(whole, tmp_path):
    """A copy to go on with."""
    return Path(shutil.copytree(whole, tmp_path / "again"))


def record(method, seeds=4, first_seed=0, scene="double_goal", reference=None, **sources):
    """A result with these metrics by source of types, as results/<scene>/<method>.json holds it."""
    types = {
        source: {metric: {"per_seed": values, "mean": float(np.mean(values))} for metric, values in of.items()}
        for source, of in sources.items()
    }
    table = config.to_dict(config.defaults(scene, method)) | {"seeds": seeds, "first_seed": first_seed}
    return {
        "scene": scene, "method": method, "metrics": types["prior"], "types": types, "reference": reference or {"expert": {}},
        "update": 1, "seeds": seeds, "episodes": 4, "asked": 4, "commit": "abc", "measured_by": "x", "config": table, "study": "few",
    }  # fmt: skip


# Numbers over seeds


def test_interval_over_seeds_is_students():
    low, high = over_seeds.interval([1.0, 2.0, 3.0])
    assert (low, high) == pytest.approx((2 - 4.3027 / np.sqrt(3), 2 + 4.3027 / np.sqrt(3)), abs=1e-4)
    assert over_seeds.interval([1.0]) is None
    assert over_seeds.number([0.0, 0.0, 0.3]).startswith("0.1 [0, ")  # a rate is not below 0


def test_sign_flip_counts_the_flips_that_are_as_far_out():
    assert over_seeds.sign_flip(np.array([1.0, 2.0, 3.0])) == pytest.approx(2 / 8)
    assert over_seeds.sign_flip(np.array([1.0, -1.0])) == pytest.approx(1.0)
    fewest = next(n for n in range(2, 9) if over_seeds.sign_flip(np.arange(1.0, n + 1)) < 0.05)
    assert fewest == over_seeds.DECIDING


def test_holm_corrects_for_the_number_of_tests():
    assert over_seeds.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert over_seeds.holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])


def test_seeds_are_paired_by_their_number():
    ours, theirs = results.seeds(record("rtc_c", first_seed=1, prior={}), [5.0, 6.0, 7.0]), {0: 100.0, 2: 1.0, 3: 2.0}
    assert over_seeds.paired(ours, theirs).tolist() == [5.0, 5.0]  # seeds 2 and 3; not the first of one with the first of the other


# Claims


def test_verdicts_need_an_interval_and_enough_seeds():
    def said(values):
        return verdicts.verdict(dict(enumerate(values)))[0]

    assert said([1.0, 1.1, 1.2]) == "too few seeds to tell (3)"
    assert said([1.0, 1.1, 1.2, 0.9]) == "yes (4 seeds)"
    assert said([-1.0, -1.1, -1.2, -0.9]) == "no (4 seeds)"
    assert said([1.0, -1.1, 1.2, -0.9]) == "tie: within the noise (4 seeds)"
    assert said([0.0] * 6) == "tie: within the noise (6 seeds)"
    assert said([1.0, 1.1, 1.2, 0.9, 1.3, 0.8]) == "yes (6 seeds)"


def analysed(held, bits, null, control=0.8):
    found = {"information": {"xi": {"bits": bits, "null_95": null}}, "probe": {"control": {"bits": control, "at_most": 0.9}}}
    return held | {"type_shift": found}


def test_claims_say_what_was_measured_and_whether_it_holds():
    held = {
        "bc": record("bc", prior={"return": [20.0, 20.5, 19.5, 20.0], "jsd_goal": [0.0] * 4}),
        "mgail": record("mgail", prior={"return": [30.0, 31.0, 32.0, 31.0], "jsd_goal": [0.1] * 4}),
        "rtc_c": analysed(
            record(
                "rtc_c", prior={"return": [29.0, 31.0, 33.0, 31.5], "jsd_goal": [0.001, 0.002, 0.001, 0.0]},
                paired={"return": [34.0, 34.1, 34.2, 34.0]}, shuffled={"return": [33.0, 33.1, 33.2, 33.0]},
            ), [0.5, 0.5, 0.6, 0.4], 0.01,
        ),
        "naive_hierarchy_c": analysed(
            record(
                "naive_hierarchy_c", prior={"return": [10.0, 11.0, 9.0, 10.0]},
                paired={"return": [33.0, 33.1, 33.2, 33.0]}, shuffled={"return": [13.0, 13.1, 13.2, 13.0]},
            ), [4.0, 4.1, 4.2, 4.0], 0.01,
        ),
    }  # fmt: skip
    rows = {line.split(" | ")[0].strip("| "): line.split(" | ") for line in claims.table("double_goal", held).splitlines()}
    verdict = {claim: cells[5] for claim, cells in rows.items() if len(cells) == 7}
    c = "(continuous types)"
    assert verdict["MGAIL returns more than BC"] == "yes (4 seeds)"
    assert verdict[f"RTC returns at least what MGAIL does {c}"] == "tie: within the noise (4 seeds)"
    assert verdict[f"RTC reaches the goals as often as experts do {c}"] == "yes (4 seeds)"
    assert verdict[f"RTC removes most of the conditional shift (paired less shuffled return) {c}"] == "yes (4 seeds)"  # 20 against 5 x 1
    assert verdict[f"RTC's types hold no luck {c}"] == "tie: within the noise (4 seeds)"  # 0.5 against 0.01 + 0.41
    assert rows[f"RTC returns at least what MGAIL does {c}"][6].startswith("MGAIL gathers more")
    assert not rows[f"RTC reaches the goals as often as experts do {c}"][6].strip("| ")
    assert "info_mgail_c was not run" in rows[f"RTC returns at least what InfoMGAIL does {c}"][3]
    assert "31.12" in rows[f"RTC returns at least what MGAIL does {c}"][3] and "section V-A" in rows["MGAIL returns more than BC"][1]
    assert claims.table("roundabout", held) == ""


def test_a_probe_that_does_not_find_what_is_there_tests_no_claim():
    """As on a few dozen demonstrations: there types hold no luck as far as anybody can see."""
    of = {"return": [1.0] * 4}
    blind = {
        name: analysed(record(name, prior=of), [-0.4, -0.5, -0.4, -0.5], -0.1, control=-0.9) for name in ("rtc_c", "naive_hierarchy_c")
    }
    row = next(line for line in claims.table("double_goal", blind).splitlines() if "RTC's types hold no luck (continuous types)" in line)
    assert "in its control neither" in row and "| not tested |" in row
    seeing = {name: analysed(held, [0.0, 0.1, 0.0, 0.1], 0.2) for name, held in blind.items()}
    row = next(line for line in claims.table("double_goal", seeing).splitlines() if "RTC's types hold no luck (continuous types)" in line)
    assert "| yes (4 seeds) |" in row


@functools.cache
def metrics_of(name):
    """Names of a scene's metrics, from features of the right shapes."""
    scene = SCENES[name]()

    def one(key):
        held = dataset.driven(scene, scene.reset(key), key)
        return scene.features(held, held.trajectory)

    features = {k: np.zeros((4, *x.shape), x.dtype) for k, x in jax.eval_shape(one, jax.random.key(0)).items()}
    return set(scene.metrics({k: x[None] for k, x in features.items()}, features))


@pytest.mark.parametrize("scene", ["double_goal", "intersection"])
def test_every_claim_is_a_margin_a_seed_of_metrics_that_its_scene_has(scene):
    about = [claim for claim in claims.CLAIMS if scene in claim.scenes]
    of = {metric: [1.0, 2.0] for metric in metrics_of(scene)}
    names = set().union(*(claim.left.names | claim.right.names for claim in about))
    held = {
        name: analysed(record(name.partition(",")[0], 2, scene=scene, prior=of, paired=of, shuffled=of), [1.0, 2.0], 0.0) for name in names
    }
    assert {name.partition(",")[0] for name in names} <= set(METHODS) and about
    assert all(set(claim.margin(held)) == {0, 1} and claim.relation in ("<=", ">=") for claim in about)


# Tables


def test_methods_are_compared_with_their_counterparts_and_corrected():
    values = {"return": [1.0, 2.0, 3.0, 5.0]}
    held = {
        name: record(name, prior={"return": [x + i for x in values["return"]]})
        for i, name in enumerate(("mgail", "symphony", "naive_hierarchy_c", "rtc_c", "rtc_d"))
    }
    lines = report.TABLES["comparisons"](held, "double_goal").splitlines()
    pairs = [tuple(line.split(" | ")[i].strip("| ") for i in (0, 1)) for line in lines if line.startswith("| ") and "---" not in line][1:]
    assert ("rtc_c", "naive_hierarchy_c") in pairs and ("rtc_c", "symphony") in pairs and ("rtc_c", "mgail") in pairs
    assert ("rtc_d", "naive_hierarchy_c") not in pairs and ("mgail", "mgail") not in pairs
    assert "| rtc_c | mgail | return | 4 | +3 [+3, +3] | 0.125 | 1 |" in lines


def test_tables_name_what_differs_from_the_committed_settings_and_other_commits():
    held = {"mgail": record("mgail", prior={"return": [1.0] * 4}), "rtc_c": record("rtc_c", first_seed=1, prior={"return": [1.0] * 4})}
    held["rtc_c"] |= {"commit": "def", "measured_by": "y"}
    text = report.TABLES["table"](held, "few")
    assert "`python -m rtc_mjx.study --scene double_goal --methods mgail --seeds 4 --name few --results results`" in text
    assert "--methods rtc_c --seeds 4 --name few --first-seed 1 --results results" in text
    assert "abc (mgail); def (rtc_c)" in text and "measured by different code" in text and "Trained at" not in text
    held["rtc_c"]["trained_by"] = [{"commit": "old"}, {"commit": "old"}, {"commit": None}]
    held["mgail"]["trained_by"] = [{"commit": "abc"}]  # the code that measured it
    assert "Trained at old, unknown (rtc_c)." in report.TABLES["table"](held, "few")
    del held["rtc_c"]["study"]  # of a run that `train` made
    assert "`python -m rtc_mjx.train --scene double_goal --method rtc_c --seeds 4 --first-seed 1`" in report.TABLES["table"](held, "few")


def test_one_method_alone_is_told_that_claims_compare_several():
    alone = {"mgail": record("mgail", prior={"return": [1.0] * 4, "jsd_goal": [0.1] * 4})}
    text = claims.table("double_goal", alone)
    assert "|" not in text and "python -m rtc_mjx.study --scene double_goal" in text
    assert "diverged" in claims.table("double_goal", {**alone, "bc": {"failed": "diverged: at update 3", "scene": "double_goal"}})


def test_a_claim_that_one_folder_tests_is_not_repeated_where_another_does_not(tmp_path):
    values = {"return": [1.0, 1.1, 0.9, 1.0], "jsd_goal": [0.1] * 4}
    for folder, methods in {"whole": ("bc", "mgail"), "few": ("mgail", "rtc_c")}.items():
        for name in methods:
            (tmp_path / folder).mkdir(exist_ok=True)
            results.write(tmp_path / folder, name, record(name, prior=values) | {"curves": {}})
    rows = [line.split(" | ") for line in claims.everywhere(tmp_path).splitlines() if line.startswith("|")]
    where = {text: [cells[0].strip("| ") for cells in rows if cells[1] == text] for text in {cells[1] for cells in rows}}
    assert where["MGAIL returns more than BC"] == ["whole"]
    assert where["RTC returns at least what MGAIL does (continuous types)"] == ["few"]
    assert where["RTC returns at least what MGAIL does (discrete types)"] == ["few", "whole"]  # nobody tests it: nothing is hidden


def test_methods_tested_on_other_recordings_are_not_compared():
    held = {name: record(name, prior={"collision_rate": [0.1] * 4}) | {"scene": "womd"} for name in ("mgail", "rtc_c", "symphony")}
    for name in held:
        held[name] |= {"recordings": {"digest": "few" if name == "symphony" else "all"}}
    held["symphony"]["metrics"] = held["symphony"]["metrics"] | {"curvature_jsd": held["symphony"]["metrics"]["collision_rate"]}
    lines = report.TABLES["comparisons"](held, "few").splitlines()
    assert any(line.startswith("| rtc_c | mgail") for line in lines) and not any("symphony" in line for line in lines if line[:1] == "|")
    rows = [line for line in report.TABLES["claims"](held, "few").splitlines() if "at most as often as Symphony (continuous" in line]
    assert len(rows) == 1 and "tested on other recordings" in rows[0] and "not tested" in rows[0]


def test_sim_agents_figures_stand_beside_log_replay():
    figures = {name: 0.5 for name in tables.SIM_AGENTS}
    held = {name: record(name, prior={"collision_rate": [0.1] * 2}) | {"scene": "womd"} for name in ("mgail", "symphony")}
    for name, digest in (("mgail", "all"), ("symphony", "few")):
        found = {"prior": [figures, figures | {"kinematic": 0.7}], "log_replay": figures | {"realism_meta_metric": 0.8}}
        held[name] |= {"recordings": {"digest": digest}, "sim_agents": found}
    text = report.TABLES["sim_agents"](held, "few")
    rows = {line.split(" | ")[0].strip("| "): line.split(" | ") for line in text.splitlines() if line.startswith("| ")}
    assert rows["mgail"][1].startswith("0.5 ± 0 ") and rows["mgail"][2].startswith("0.6 ± 0.14 ")
    assert rows["log replay"][1:3] == ["0.8", "0.5"] and "other recordings than the first row: symphony." in text
    assert report.TABLES["sim_agents"]({"mgail": record("mgail", prior={"return": [1.0]})}, "few") == ""


def test_runs_are_not_reported_among_studies_nor_claims_beside_a_lone_one(tmp_path, monkeypatch):
    values = {"return": [1.0] * 4, "jsd_goal": [0.1] * 4}
    held = record("mgail", reference={"expert": {name: x[0] for name, x in values.items()}}, prior=values) | {"curves": {}}
    (tmp_path / "few").mkdir()
    results.write(tmp_path / "few", "mgail", {name: value for name, value in held.items() if name != "study"})
    report.main([str(tmp_path / "few")])
    assert not (tmp_path / "claims.md").exists()
    results.write(tmp_path / "few", "mgail", held)
    report.main([str(tmp_path / "few")])
    assert (tmp_path / "claims.md").is_file()
    monkeypatch.setattr(results, "of_run", lambda run: held)
    with pytest.raises(UsageError, match="holds studies .few.; name a folder of its own"):
        report.of_runs([SimpleNamespace(config=SimpleNamespace(scene=SimpleNamespace(name="double_goal"), method="mgail"))], tmp_path)
    with pytest.raises(UsageError, match="claims.md: .*a folder for results is needed"):
        report.made(tmp_path / "claims.md")


def test_options_of_a_result_give_its_settings_again():
    argv = ["--scene", "double_goal", "--method", "rtc_d", "--losses.type-kl", "0.003", "--no-choice"]
    argv = [*argv[:-1], "--model.no-choice-gradient", "--scene.steps", "20", "--first-seed", "3", "--seeds", "2"]
    wanted = config.to_dict(config.from_command_line(argv, "test"))
    options = results.options(wanted)
    again = config.from_command_line(["--scene", "double_goal", "--method", "rtc_d", "--seeds", "2", *options], "test")
    assert config.to_dict(again) == wanted and "--losses.type-kl" in options and "--batch" not in options


def test_labels_are_moved_apart_and_no_further():
    assert charts.apart([0.1, 0.5], 0.1) == pytest.approx([0.1, 0.5])
    assert charts.apart([0.5, 0.5, 0.5], 0.1) == pytest.approx([0.4, 0.5, 0.6])
    assert charts.apart([0.99, 0.99], 0.1) == pytest.approx([0.9, 1.0])  # not above the axes
    moved = charts.apart([0.1, 0.12, 0.21, 0.9], 0.1)
    assert np.all(np.diff(moved) > 0.0999) and np.mean(moved[:3]) == pytest.approx(np.mean([0.1, 0.12, 0.21]))


def shift_of(seeds=4):
    of = {"return": [30.0] * seeds}
    return {
        "update": 4, "types": {"paired": of, "same_xi": of, "shuffled": {"return": [12.0] * seeds}, "prior": {"return": [11.0] * seeds}},
        "information": {"xi": {"bits": [2.0] * seeds, "null_95": 0.01}},
        "realism": {"episodes": 8, "experts": 4, "features": {"return": {"agent": [0.3] * seeds, "floor": 0.05}}},
    }  # fmt: skip


def test_what_types_carry_and_conditional_realism_have_a_row_for_every_method():
    held = {
        "bc": record("bc", prior={"return": [1.0] * 4}) | {"type_shift": {"realism": shift_of()["realism"]}},
        "mgail": record("mgail", prior={"return": [1.0] * 4}) | {"type_shift": {}},  # as of recordings
        "rtc_c": record("rtc_c", prior={"return": [1.0] * 4}) | {"type_shift": shift_of() | {"commit": "analysed"}},
    }
    shift, realism = (report.TABLES[name](held, "double_goal").splitlines() for name in ("type_shift", "conditional_realism"))
    assert sum(line.startswith("| rtc_c") for line in shift) == 1 and "| -18 [-18, -18] | -1 [-1, -1] | 2 ± 0 [2, 2] | 0.01 |" in shift[2]
    assert not any(line.startswith("| bc") for line in shift)
    assert [line.split(" | ")[2].strip(" |") for line in realism if line.startswith(("| bc", "| rtc_c"))] == ["0.05", "0.05"]
    assert "Commit analysed." in shift[-1] and "analysed (rtc_c)" in realism[-1]  # of the analysis, not of the evaluation before it


def test_the_figure_of_type_shift_has_every_seed_under_every_source_of_types(tmp_path, monkeypatch):
    held = {name: record(name, prior={"return": [11.0] * 4}) for name in ("bc", "rtc_c", "rtc_d")}
    held |= {name: held[name] | {"type_shift": shift_of()} for name in ("rtc_c", "rtc_d")}
    for of in held.values():
        of["reference"] = {"expert": {"return": 31.0}}
    drawn = []
    monkeypatch.setattr(charts, "save", lambda canvas, file: drawn.append(canvas))
    charts.type_shift(held, tmp_path / "type_shift.png")
    axis = drawn[0].axes[0]
    points = sorted(x for line in axis.lines if line.get_marker() == "." for x in line.get_xdata())
    assert points == [11.0] * 8 + [12.0] * 8 + [30.0] * 16
    assert [label.get_text() for label in axis.get_yticklabels()] == ["rtc_c", "rtc_d"]  # bc reads no types off trajectories
    heights = [line.get_ydata()[0] for line in axis.lines if line.get_marker() == "."]
    assert len(set(heights)) == 8
    charts.type_shift({"bc": held["bc"]}, tmp_path / "type_shift.png")
    assert len(drawn) == 1 and len(drawn[0].axes) == 1  # the goals' divergence was not measured


# Studies


def numbers(place):
    """All that a study found, without when and where it did."""
    out = {}
    for file in sorted((place / "double_goal").glob("*.json")):
        held = json.loads(file.read_text())
        out[file.name] = {key: held[key] for key in held if key != "versions"}
    return out | {file.name: file.read_text() for file in sorted((place / "double_goal").glob("*.md"))}


def test_a_study_tells_all_that_it_found(whole):
    out = whole / "double_goal"
    made = {file.name for file in out.iterdir()}
    assert {"table.md", "comparisons.md", "claims.md", "conditional_realism.md", "curves.png", "overview.png"} <= made
    assert (whole / "claims.md").read_text().count("MGAIL returns more than BC") == 1
    text = (out / "conditional_realism.md").read_text()
    assert "| bc |" in text and "| mgail |" in text and "floor" in text
    held = json.loads((out / "bc.json").read_text())
    assert held["curves"]["return"]["updates"] == [4] and held["type_shift"]["realism"]["experts"] == entry.EXPERTS
    text = (out / "table.md").read_text()
    assert "python -m rtc_mjx.study --scene double_goal --methods bc,mgail --seeds 2 --scene.steps 16 --updates 4" in text


STOPS = [
    (config, "write"),  # a run directory without its settings
    (Run, "save"),  # between a line of metrics and its checkpoint
    (evaluate, "main"),
    (type_shift, "main"),
    (results, "write"),
    (report, "rebuild"),
]


def test_a_study_that_was_stopped_anywhere_ends_like_one_that_was_not(whole, tmp_path, monkeypatch):
    (tmp_path / "runs" / "double_goal" / "bc").mkdir(parents=True)  # stopped before anything was written
    for module, name in STOPS:
        with monkeypatch.context() as patched:
            patched.setattr(module, name, lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                study.main(command(tmp_path, "bc"))
    study.main(command(tmp_path, "bc"))
    assert numbers(tmp_path)["bc.json"] == numbers(whole)["bc.json"]


def test_a_killed_study_ends_like_one_that_was_not(whole, tmp_path):
    """SIGKILL after the evaluation is written, while types are analysed."""
    argv = [sys.executable, "-m", "rtc_mjx.study", *command(tmp_path, "bc")]
    with subprocess.Popen(argv, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as child:
        deadline = time.monotonic() + 200
        while not (tmp_path / "runs/double_goal/bc/evaluation.json").is_file() and child.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        child.send_signal(signal.SIGKILL)
    assert not (tmp_path / "double_goal").is_dir() or not any((tmp_path / "double_goal").iterdir())
    study.main(command(tmp_path, "bc"))
    assert numbers(tmp_path)["bc.json"] == numbers(whole)["bc.json"]


def test_what_is_finished_is_not_done_again(again, monkeypatch):
    for module in (train, evaluate, type_shift):
        monkeypatch.setattr(module, "train" if module is train else "main", lambda *_: pytest.fail("done again"))
    study.main(command(again, "bc,mgail"))


def test_results_of_another_command_stay_and_those_there_are_shown_before_anything_is_trained(again, whole, monkeypatch):
    before = (again / "double_goal" / "table.md").read_text()
    for file in (again / "double_goal").iterdir():
        file.unlink()  # as after a clean checkout; the runs are there
    monkeypatch.setattr(study, "complete", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        study.main(command(again, "rtc_c"))
    assert (again / "double_goal" / "table.md").read_text() == before
    assert {"bc.json", "mgail.json"} <= {file.name for file in (again / "double_goal").iterdir()}
    shutil.rmtree(again / "runs")  # and where the runs are gone, the results are not
    with pytest.raises(KeyboardInterrupt):
        study.main(command(again, "rtc_c"))
    assert (again / "double_goal" / "table.md").read_text() == before


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--losses.cloning", "2.0"], r"--losses\.cloning 2\.0 is wanted.*has 1\.0"),
        (["--first-seed", "5"], "--first-seed 5 --seeds 2 is wanted.*has seeds 0 to 1"),
        (["--updates", "8"], "--updates 8 is wanted.*has 4"),
    ],
)
def test_a_finished_run_of_other_settings_is_not_taken_for_the_one_wanted(again, options, named, monkeypatch):
    monkeypatch.setattr(study, "complete", lambda *_: pytest.fail("that is known before anything is trained"))
    with pytest.raises(UsageError, match=named) as caught:
        study.main(command(again, "rtc_c,mgail", *options))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("method", "matters"), [("mgail", False), ("gail", True)])
def test_settings_that_a_method_does_not_read_do_not_make_another_run_of_it(method, matters):
    held = config.defaults("double_goal", method)
    other = dataclasses.replace(held, losses=dataclasses.replace(held.losses, policy_gradient=7.0))
    run = SimpleNamespace(config=held, folder=Path("run"))
    entry.check_same(held, run)
    with pytest.raises(UsageError, match="losses.policy-gradient 7.0 is wanted") if matters else contextlib.nullcontext():
        entry.check_same(other, run)


def test_committed_settings_that_changed_are_seen_too(again, monkeypatch):
    """Going on with a run takes its own settings; the study asks for those of today."""
    (again / "configs").mkdir()
    (again / "configs" / "double_goal.toml").write_text("[losses]\ncloning = 0.5\n")
    monkeypatch.setattr(config.files, "configs", lambda: again / "configs")
    with pytest.raises(UsageError, match=r"(wanted|is wanted).*has"):
        study.main(command(again, "bc"))


def test_what_other_code_measured_is_measured_again(again, monkeypatch):
    done = []
    monkeypatch.setattr(evaluate, "main", lambda argv: done.append("evaluated") or restamp(again, "evaluation.json"))
    monkeypatch.setattr(type_shift, "main", lambda argv: done.append("analysed") or restamp(again, "type_shift.json"))
    monkeypatch.setattr(provenance, "measured_by", lambda: "newer")
    study.main(command(again, "bc"))
    assert done == ["evaluated", "analysed"]
    study.main(command(again, "bc"))
    assert len(done) == 2


def restamp(place, name, **changes):
    file = place / "runs" / "double_goal" / "bc" / name
    file.write_text(json.dumps(json.loads(file.read_text()) | {"measured_by": provenance.measured_by(), **changes}))


def test_fewer_episodes_looked_at_by_hand_do_not_count(again):
    run = Run.open(again / "runs" / "double_goal" / "bc")
    assert entry.evaluated(run) and entry.shift_found(run, 32)
    restamp(again, "evaluation.json", asked=8)
    restamp(again, "type_shift.json", episodes=16)
    assert not entry.evaluated(run) and not entry.evaluated(run, now=False) and not entry.shift_found(run, 32)


def test_a_last_checkpoint_that_cannot_be_read_is_trained_again(again, whole):
    """Its name alone says nothing: a result of an earlier update would stand in the table as that of the last."""
    folder = again / "runs" / "double_goal" / "bc"
    for part in (folder / "checkpoints" / "4" / "state").rglob("*"):
        if part.is_file():
            part.write_bytes(part.read_bytes()[: part.stat().st_size // 2])
    (folder / "evaluation.json").unlink()
    study.main(command(again, "bc,mgail"))
    assert numbers(again) == numbers(whole)
    assert any("unreadable" in p.name for p in (folder / "checkpoints").iterdir())  # nothing is thrown away


def test_a_training_that_diverges_has_a_row_and_does_not_stop_the_others(again, monkeypatch):
    really = study.complete

    def complete(of, scene, folder, team):
        if of.name == "bc":
            raise DivergedError("update 2: cloning of seed 0 is not finite")
        return really(of, scene, folder, team)

    with monkeypatch.context() as patched:
        patched.setattr(study, "complete", complete)
        with pytest.raises(study.RunError, match="bc failed: update 2"):
            study.main(command(again, "bc,mgail"))
    out = again / "double_goal"
    assert "| bc | diverged: update 2: cloning of seed 0 is not finite |" in (out / "table.md").read_text()
    assert "bc diverged" in (out / "claims.md").read_text() and (out / "bc.json").is_file()
    study.main(command(again, "bc"))  # it went well this time
    assert "diverged" not in (out / "table.md").read_text() and not (out / "bc.failed.json").exists()


def test_tables_and_figures_are_made_again_from_the_json_files_alone(again, whole):
    out = again / "double_goal"
    shutil.rmtree(again / "runs")
    for file in [*out.glob("*.md"), *out.glob("*.png"), again / "claims.md"]:
        file.unlink()
    report.main([str(out)])
    assert numbers(again) == numbers(whole) and "MGAIL returns more than BC" in (again / "claims.md").read_text()
    for name in ("curves.png", "overview.png", "conditional_realism.png"):
        assert (out / name).read_bytes() == (whole / "double_goal" / name).read_bytes()
    (out / "bc.json").write_text("{")
    with pytest.raises(UsageError, match=r"bc\.json is damaged"):
        report.main([str(out)])


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        ({"metrics": None}, r"lacks metrics: .*another version"),
        ({"curves": None, "config": None}, "lacks config, curves"),
        ({"config": {}}, "'config' lacks first_seed, method"),
        ({"config": []}, "damaged"),
        ({"reference": {}}, "'reference' lacks expert"),
        ({"seeds": []}, r"'seeds' is \[\]"),
        ({"seeds": 9}, "not 9 numbers"),
        ({"types": {"prior": {"return": {"mean": "many", "std": 0.0, "per_seed": [1.0, 2.0]}}}}, r"return \(prior\) is not"),
        ({"types": {"prior": {"return": 3.0}}}, "damaged"),
    ],
)
def test_a_result_of_wrong_content_is_one_line(damage, named, whole, tmp_path):
    held = json.loads((whole / "double_goal" / "bc.json").read_text()) | damage
    (tmp_path / "bc.json").write_text(json.dumps({key: value for key, value in held.items() if value is not None}))
    with pytest.raises(UsageError, match=rf"bc\.json.*{named}") as told:
        report.main([str(tmp_path)])
    assert "\n" not in str(told.value)


def test_json_files_of_other_things_are_no_results(tmp_path):
    for text in ('{"scene": "double_goal"}', "[]", "3"):
        (tmp_path / "notes.json").write_text(text)
        with pytest.raises(UsageError, match="holds no results"):
            report.main([str(tmp_path)])


def test_committed_results_can_be_read(tmp_path):
    """Results of earlier versions, too, become tables."""
    for place in {file.parent for file in ROOT.glob("results/*/table.md")}:
        shutil.copytree(place, tmp_path / place.name)
    report.main([str(tmp_path)])
    assert "| rtc_c | prior |" in (tmp_path / "intersection" / "table.md").read_text() and (tmp_path / "claims.md").is_file()


def test_a_study_is_named_by_a_name(tmp_path):
    with pytest.raises(UsageError, match=r"--name a/b: a name"):
        study.main(["--scene", "double_goal", "--name", "a/b", "--results", str(tmp_path)])


# Variations


def test_variations_are_compared_with_what_they_vary(again, monkeypatch):
    """End to end, on a method that is quick to train."""
    monkeypatch.setattr(study, "VARIATIONS", {"optimiser.learning-rate": ("bc", (0.02,))})
    monkeypatch.setattr(type_shift, "main", lambda argv: (Path(argv[1]) / "type_shift.json").write_text(json.dumps(shift_of(2))))
    study.main(command(again, "mgail", "--ablations"))
    out, name = again / "double_goal", "bc,optimiser.learning-rate=0.02"
    text = (out / "ablations.md").read_text()
    assert "| bc | 2 |" in text and f"| {name} | 2 |" in text and "--ablations" in text
    base, varied = (json.loads((out / f"{of}.json").read_text())["metrics"]["return"]["per_seed"] for of in ("bc", name))
    assert f" {np.mean(np.subtract(varied, base)):+.3g} [" in next(line for line in text.splitlines() if name in line)
    assert "learning-rate" not in (out / "table.md").read_text() and f"| {name} |" in (out / "conditional_realism.md").read_text()
    assert (out / "ablations.png").read_bytes().startswith(b"\x89PNG")


def test_the_naive_hierarchy_stands_at_an_encoder_share_of_one():
    of = {"prior": {"return": [1.0] * 4}}
    held = {
        "rtc_c": record("rtc_c", **of),
        "rtc_c,encoder-share=0.5": record("rtc_c", **of),
        "naive_hierarchy_c": record("naive_hierarchy_c", **of),
    }
    assert [(value, name) for value, (name, _) in charts._values(held, "rtc_c", "encoder-share").items()] == [
        ("0.375", "rtc_c"), ("0.5", "rtc_c,encoder-share=0.5"), ("1.0", "naive_hierarchy_c"),
    ]  # fmt: skip


def test_variations_start_from_the_options_given():
    held = study.entries("double_goal", ["rtc_c"], True, ["--losses.adversarial", "3.0"])
    varied = [e.name for e in held if "adversarial" in e.name]
    assert "rtc_c,losses.adversarial=3.0" not in varied and "rtc_c,losses.adversarial=1.0" in varied


def test_variations_change_one_thing_each_and_are_settings_that_exist():
    held = study.entries("double_goal", ["rtc_c", "rtc_d"], True, [])
    assert len({of.name for of in held}) == len(held) > 10 and any("rtc_d,model.type-count" in of.name for of in held)
    for of in held:
        settings = entry.resolved(of, "double_goal")
        differs = results.options(config.to_dict(settings))
        assert differs == list(of.options) and len(differs) == (2 if "," in of.name else 0)


def test_a_folder_in_the_way_is_left_alone(tmp_path):
    place = tmp_path / "double_goal" / "bc"
    place.mkdir(parents=True)
    (place / "thesis.txt").write_text("years of work")
    with pytest.raises(UsageError, match="in the way"):
        study.complete(study.Entry("bc", "bc"), "double_goal", place)
    assert (place / "thesis.txt").is_file()
