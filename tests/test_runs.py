"""Trainings as a user runs them: every method learns, runs resume exactly, nothing is lost or overwritten, errors are one line."""

import dataclasses
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from learning import ON_SCENE, SCENE, settings

from rtc_mjx import config, dataset, evaluate, populations, render, report, results, train
from rtc_mjx.config import Config
from rtc_mjx.errors import RunError, UsageError
from rtc_mjx.runs import Run
from rtc_mjx.scenes import SCENES
from rtc_mjx.trained import rollouts

ROOT = Path(__file__).resolve().parents[1]
SMALL = ["--scene", "double_goal", "--scene.steps", "16", "--updates", "40", "--batch", "16", "--model.width", "16"]
SMALL += ["--experts.train", "256", "--experts.test", "64", "--every.log", "10", "--every.test", "20", "--every.save", "20"]


def lines(run):
    """The metrics of a run without the time they took."""
    return [{k: v for k, v in line.items() if k != "wall_s"} for line in run.metrics()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run."""
    return train.train(settings("rtc_c", tmp_path_factory.mktemp("whole") / "run", seeds=2))


@pytest.mark.parametrize("method", ON_SCENE)
def test_every_method_learns(method, tmp_path):
    """A real short training: what it clones or reconstructs falls, nothing is dropped, all that is logged is finite."""
    run = train.train(settings(method, tmp_path / "run", updates=60, every=config.Intervals(10, 60, 60)))
    held = run.metrics()
    name = "cloning"
    assert held[-1][name][0] < held[0][name][0] - 0.1
    assert all(np.all(np.isfinite(v)) for line in held for v in line.values())
    assert held[-1]["update"] == 60 and held[-1].get("trajectories_dropped", [0]) == [0]
    assert set(SCENE.main_metrics) <= set(held[-1])


def test_interrupted_run_resumes_bit_for_bit(whole, tmp_path, monkeypatch):
    first = settings("rtc_c", tmp_path / "run", seeds=2)
    saved = Run.save

    def stop(run, update, state, wall_s):
        saved(run, update, state, wall_s)
        if update == 20:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Run, "save", stop)
        with pytest.raises(KeyboardInterrupt):
            train.train(first)
    resumed = train.train(dataclasses.replace(first, resume=True))
    assert lines(resumed) == lines(whole)


def test_a_training_that_diverges_says_so_and_keeps_its_checkpoints(tmp_path):
    wild = dataclasses.replace(settings("bc").optimiser, learning_rate=1e30, clip=1e30)
    with pytest.raises(RunError, match=r"update 10: .* of seed 0 is not finite.*learning rate"):
        train.train(settings("bc", tmp_path / "run", optimiser=wild))


def test_ctrl_c_saves_a_checkpoint_first(tmp_path, monkeypatch):
    logged = Run.log

    def interrupt(run, line):
        logged(run, line)
        if line["update"] == 10:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Run, "log", interrupt)
    with pytest.raises(KeyboardInterrupt):
        train.train(settings("bc", tmp_path / "run"))
    assert list(Run.open(tmp_path / "run").checkpoints()) == [10]


def test_killed_run_resumes_bit_for_bit(tmp_path):
    """SIGKILL at a moment of its own choosing; what was left behind goes on to the same numbers."""
    often = ["--updates", "120", "--every.test", "40", "--every.save", "10"]
    command = [sys.executable, "-m", "rtc_mjx.train", "--method", "bc", *SMALL, *often]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([*command, "--run", str(tmp_path / "a")], env=env, capture_output=True, check=True, timeout=300)
    with subprocess.Popen([*command, "--run", str(tmp_path / "b")], env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as child:
        deadline = time.monotonic() + 200
        while not any((tmp_path / "b" / "checkpoints").glob("[1-9]*")) and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.3)
        assert child.poll() is None  # or it would have ended by itself
        child.kill()
    resumed = ["--run", str(tmp_path / "b"), "--resume"]
    done = subprocess.run([sys.executable, "-m", "rtc_mjx.train", *resumed], env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert lines(Run.open(tmp_path / "b")) == lines(Run.open(tmp_path / "a"))


def test_a_run_describes_itself(whole):
    assert {p.name for p in whole.folder.iterdir()} >= {"config.json", "metrics.jsonl", "checkpoints", "media"}
    assert any(p.name.startswith("events.out.tfevents") for p in whole.folder.iterdir())
    assert config.to_dict(Run.open(whole.folder).config) == config.to_dict(whole.config)
    line = whole.metrics()[-1]
    assert {
        "update",
        "wall_s",
        "env_steps",
        "gradient_norm_policy",
        "gradient_norm_encoder",
        "gradient_norm_prior",
        "gradient_norm_discriminator",
        "accuracy_expert",
        "accuracy_policy",
        "type_kl",
        "return",
    } <= set(line)
    assert all(len(v) == 2 for v in line.values() if isinstance(v, list))


def test_seeds_are_what_they_are_alone(whole, tmp_path):
    """The second seed of two is the training that the seed gives on its own, to float rounding."""
    alone = train.train(settings("rtc_c", tmp_path / "run", first_seed=1, updates=20))
    for ours, theirs in zip(alone.metrics()[:1], whole.metrics(), strict=False):
        for name in ("cloning", "type_kl", "adversarial"):
            assert ours[name][0] == pytest.approx(theirs[name][1], rel=0.02)
    assert whole.metrics()[0]["cloning"][0] != whole.metrics()[0]["cloning"][1]


def test_truncated_checkpoint_falls_back_to_the_one_before(whole, tmp_path, caplog):
    run = copy(whole, tmp_path)
    biggest = max((p for p in (run.folder / "checkpoints" / "40").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    biggest.write_bytes(biggest.read_bytes()[: biggest.stat().st_size // 2])
    resumed = train.train(dataclasses.replace(run.config, resume=True))
    assert "checkpoint 40" in caplog.text and lines(resumed) == lines(whole)


def test_altered_checkpoint_is_not_believed(whole, tmp_path, monkeypatch):
    run = copy(whole, tmp_path)
    monkeypatch.setattr("rtc_mjx.runs._digest", lambda state: "another")
    with pytest.raises(UsageError, match="no whole checkpoint"):
        evaluate.evaluate(run, 16)


def test_a_run_of_networks_of_other_shapes_is_refused_for_what_it_is(whole, tmp_path):
    run = copy(whole, tmp_path)
    file = run.folder / "config.json"
    file.write_text(file.read_text().replace(f'"width": {whole.config.model.width}', f'"width": {whole.config.model.width + 1}'))
    with pytest.raises(
        UsageError, match=r"other code or settings .* an array of \(.*\) where config.json asks for \(.*\); .* train anew"
    ) as caught:
        evaluate.evaluate(Run.open(run.folder), 16)
    assert "\n" not in str(caught.value)
    with pytest.raises(UsageError, match="other code or settings"):
        train.train(dataclasses.replace(Run.open(run.folder).config, resume=True))


def test_metrics_cut_short_by_a_crash_lose_only_the_last_line(whole, tmp_path):
    run = copy(whole, tmp_path)
    with run.metrics_file.open("a") as file:
        file.write('{"update": 50, "wall')
    assert lines(run) == lines(whole)
    for damage in (b'{"updat": 1}', b'{"update": "x"}', b"[]", b"{", b"\xff\xfe"):
        held = run.metrics_file.read_bytes()
        run.metrics_file.write_bytes(damage + b"\n" + held)
        with pytest.raises(UsageError, match="line 1 is damaged"):
            run.metrics()
        run.metrics_file.write_bytes(held)
    run.rewind(20)
    assert [line["update"] for line in run.metrics()] == [10, 20]
    for word in ('"many"', "3.0", "[null, 1.0]"):
        run.metrics_file.write_text(f'{{"update": 10, "return": {word}}}\n')
        with pytest.raises(UsageError, match="'return' of some line is not a list of numbers"):
            results.curves(run)


def test_full_disk_loses_no_checkpoint(whole, tmp_path):
    """A limit on file size stands in for the disk: the new checkpoint fails in one line, those before are whole."""
    run = copy(whole, tmp_path)
    before = list(run.checkpoints())
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, hard))
    try:
        with pytest.raises(RunError, match=r"^checkpoint 60 could not be written"):
            run.save(60, {"x": np.random.default_rng(0).normal(size=100_000)}, 1.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(run.checkpoints()) == before
    evaluate.evaluate(run, 16)


def test_full_disk_during_a_training_is_one_error_and_no_hang(tmp_path, monkeypatch):
    """TensorBoard's file and the checkpoint both fail; the checkpoint's error is what comes out."""
    saved = Run.save

    def full(run, update, state, wall_s):
        if update < 40:
            return saved(run, update, state, wall_s)
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (64, hard))
        try:
            return saved(run, update, state, wall_s)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    monkeypatch.setattr(Run, "save", full)
    with pytest.raises(RunError, match="checkpoint 40 could not be written"):
        train.train(settings("bc", tmp_path / "run"))
    monkeypatch.setattr(Run, "save", saved)
    resumed = train.train(dataclasses.replace(settings("bc", tmp_path / "run"), resume=True))
    assert [line["update"] for line in resumed.metrics()] == [10, 20, 30, 40]
    assert not list((resumed.folder / "checkpoints").glob("*tmp*"))


def test_two_processes_do_not_train_in_one_run(whole):
    with whole.lock(), pytest.raises(UsageError, match="another process"):
        train.train(dataclasses.replace(whole.config, resume=True))


def copy(run, tmp_path):
    import shutil

    shutil.copytree(run.folder, tmp_path / "copy")
    return Run.open(tmp_path / "copy")


# Evaluation, video, report


@pytest.fixture(scope="module")
def evaluated(whole):
    evaluate.main(["--run", str(whole.folder), "--episodes", "64"])
    return json.loads((whole.folder / "evaluation.json").read_text())


def test_evaluation_has_what_the_interface_says(evaluated):
    assert {"scene", "method", "seeds", "episodes", "metrics", "types", "reference"} <= set(evaluated)
    assert set(evaluated["types"]) == {"prior", "paired", "shuffled"}
    assert set(evaluated["reference"]) == {"expert", "expert_vs_expert"}
    for summary in evaluated["metrics"].values():
        assert len(summary["per_seed"]) == 2 and summary["mean"] == pytest.approx(np.mean(summary["per_seed"]))
    assert evaluated["types"]["prior"] == evaluated["metrics"]
    low, high = evaluated["metrics"]["return"]["interval"]
    assert low <= evaluated["metrics"]["return"]["mean"] <= high
    assert evaluated["reference"]["expert"]["jsd_goal"] == 0 < evaluated["reference"]["expert"]["lower"]


def test_evaluation_is_repeatable(whole, evaluated):
    assert json.loads(json.dumps(evaluate.evaluate(whole, 64))) == evaluated


def test_evaluation_agrees_with_the_last_test_of_the_training(whole, evaluated):
    """Same episodes, same noise, same checkpoint."""
    line = whole.metrics()[-1]
    for name in SCENE.main_metrics:
        assert np.allclose(line[name], evaluated["metrics"][name]["per_seed"])
        assert np.allclose(line[f"paired/{name}"], evaluated["types"]["paired"][name]["per_seed"])


def test_methods_without_an_encoder_are_tested_under_the_prior_alone(tmp_path):
    run = train.train(settings("mgail", tmp_path / "run", updates=10, every=config.Intervals(10, 10, 10)))
    assert set(evaluate.evaluate(run, 16)["types"]) == {"prior"}


@pytest.mark.parametrize("camera", ["top", "tilted"])
def test_render_writes_a_video_in_which_things_move(whole, tmp_path, camera):
    import av

    out = tmp_path / "film.mp4"
    render.main(["--run", str(whole.folder), "--out", str(out), "--camera", camera, "--episodes", "1", "--types", "2", "--size", "96x64"])
    with av.open(str(out)) as film:
        frames = [f.to_ndarray(format="rgb24").astype(float) for f in film.decode(video=0)]
    assert len(frames) == SCENE.steps + render.HOLD and frames[0].shape == (64, 96, 3)
    assert np.abs(frames[0] - frames[-1]).max() > 40 and frames[0].std() > 5


def test_populations_are_drawn_beside_experts_in_the_same_part_of_the_world(whole, tmp_path):
    populations.main([str(whole.folder), "--out", str(tmp_path / "who.png"), "--agents", "3"])
    assert (tmp_path / "who.png").read_bytes().startswith(b"\x89PNG")
    scene, shown, held = populations.of_runs([whole], 2, 3)
    assert list(held) == ["expert", "rtc_c"]
    assert {np.asarray(track.states.qpos).shape for track in held.values()} == {(2, 3, SCENE.steps + 1, 2)}
    _, of_second = rollouts(whole, 2, 3, seed=1)
    np.testing.assert_array_equal(rollouts(whole, 2, 3)[1].states.qpos, held["rtc_c"].states.qpos)
    assert not np.array_equal(of_second.states.qpos, held["rtc_c"].states.qpos)
    later = Run(whole.folder, dataclasses.replace(whole.config, first_seed=3))  # the seeds' own numbers, not their places
    for seed in (0, 5):
        with pytest.raises(UsageError, match=f"--seed {seed}: .* has seeds 3 to 4"):
            rollouts(later, 2, 3, seed=seed)
    left, right, *_ = populations.draw(scene, shown, held).axes
    assert left.get_xlim() == right.get_xlim() and left.get_ylim() == right.get_ylim()


@pytest.mark.parametrize("name", ["double_goal", "intersection"])
def test_ways_are_coloured_by_where_they_lead_from_where_they_headed(name):
    scene, heading = SCENES[name](), 2.0 if name == "intersection" else 0.0
    turned = [(1.0, 0.5), (1.0, -0.1), (0.8, -2.5), (0.05, 1.5)]  # how far, and by which angle
    ways = np.zeros((4, 2, scene.world.mj.nq))
    ways[:, 1, :2] = [(far * np.cos(heading + angle), far * np.sin(heading + angle)) for far, angle in turned]
    if name == "intersection":
        ways[:, :, 2] = heading
    assert populations.directions(scene, ways) == [populations.LEFT, populations.STRAIGHT, populations.RIGHT, populations.STRAIGHT]


def test_the_ray_caster_sees_what_is_there():
    """A red sphere before the camera is a red disc in the middle, sky around it."""
    import mujoco

    from rtc_mjx.camera import SKY, RayCamera

    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><camera name='c' pos='0 0 3'/><geom type='sphere' size='.3' rgba='1 0 0 1'/></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    picture = RayCamera(model, "c", 60, 80)(data)
    assert picture[30, 40, 0] > 200 and picture[30, 40, 1:].max() == 0
    assert np.allclose(picture[0, 0], (255 * SKY).astype(int), atol=1)
    radius = 60 / 2 / np.tan(np.radians(model.cam_fovy[0]) / 2) * 0.3 / np.sqrt(9 - 0.09)
    assert (picture[..., 1] == 0).sum() == pytest.approx(np.pi * radius**2, rel=0.05)


def test_report_draws_curves_and_writes_a_table(whole, evaluated, tmp_path):
    report.main([str(whole.folder), "--out", str(tmp_path / "out")])
    text = (tmp_path / "out" / "table.md").read_text()
    assert "rtc_c" in text and "shuffled" in text and "expert vs expert" in text
    assert (tmp_path / "out" / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "out" / "overview.png").read_bytes().startswith(b"\x89PNG")
    held = json.loads((tmp_path / "out" / "rtc_c.json").read_text())
    assert held["metrics"] == evaluated["metrics"] and held["config"]["method"] == "rtc_c" and "jax" in held["versions"]


# Bad input


def refused(argv, named):
    with pytest.raises(UsageError, match=named) as caught:
        config.from_command_line(argv, "train")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (["--scene", "nowhere"], "nowhere.*double_goal"),
        (["--method", "magic"], "magic.*rtc_c"),
        (["--method", "symphony", "--scene", "double_goal"], "symphony.*labels"),
        (["--updates", "0"], "updates 0.*at least 1"),
        (["--updates", "many"], "updates.*many"),
        (["--losses.adversaria", "1"], r"adversaria.*--losses\.adversarial"),
        (["--losses.adversarial", "-1"], "adversarial -1.*from 0"),
        (["--losses.type-kl", "nan"], "type-kl nan"),
        (["--encoder-share", "1.5"], r"encoder-share 1\.5.*between 0 and 1"),
        (["--encoder-share", "0", "--method", "rtc"], "encoder-share.*both parts"),
        (["--every.test", "150"], r"every\.test 150.*multiple"),
        (["--losses.kl-direction", "sideways"], "sideways.*posterior_prior"),
        (["--optimiser.learning-rate", "0"], "learning-rate 0.*positive"),
        (["--scene"], "scene"),
        (["--resume"], "--run"),
    ],
)
def test_wrong_options_are_refused_in_one_line(argv, named):
    refused(argv, named)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("updates = 'ten'", "updates.*'ten'.*int"),
        ("updates = true", "updates.*True"),
        ("updates = -4", "updates -4"),
        ("[losses]\nadverserial = 1.0", "adverserial.*adversarial"),
        ("losses = 3", "losses.*table"),
        ("[losses]\nkl_direction = 'up'", "'up'.*posterior_prior"),
        ("[methods.magic]\nupdates = 3", "magic.*rtc_c"),
        ("updates = ", "double_goal.toml"),
        ("methods = 3", "methods.*table"),
        ("[methods]\nbc = 3", "bc.*table"),
        ("method = 'bc'", "method.*command line"),
    ],
)
def test_wrong_settings_files_are_refused_in_one_line(text, named, tmp_path, monkeypatch):
    (tmp_path / "double_goal.toml").write_text(text)
    monkeypatch.setattr(config.files, "configs", lambda: tmp_path)
    refused(["--scene", "double_goal"], named)


def test_settings_come_from_defaults_then_file_then_method_then_command_line(tmp_path, monkeypatch):
    text = "updates = 100\nbatch = 8\nseeds = 3\n[losses]\nadversarial = 0.5\n[methods.bc]\nbatch = 12\nseeds = 5\n"
    (tmp_path / "double_goal.toml").write_text(text)
    monkeypatch.setattr(config.files, "configs", lambda: tmp_path)
    held = config.from_command_line(["--method", "bc", "--seeds", "7"], "train")
    assert (held.updates, held.batch, held.seeds, held.losses.adversarial) == (100, 12, 7, 0.5)
    assert held.losses.reconstruction == Config().losses.reconstruction


@pytest.mark.parametrize("scene", SCENES)
def test_committed_settings_are_valid_for_every_method(scene):
    for method in ON_SCENE:
        config.defaults(scene, method)


def test_making_a_run_directory_that_was_stopped_can_be_done_again(tmp_path, monkeypatch):
    """A directory with settings is whole: whoever finds them finds the recordings too."""
    wanted = settings("bc", tmp_path / "run")
    monkeypatch.setattr(type(wanted.scene), "recordings", lambda self: ["train a 1", "test b 2"])
    with monkeypatch.context() as patched:
        patched.setattr(config, "write", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            Run.create(wanted)
    refused(["--run", str(tmp_path / "run"), "--resume"], "not a run directory")
    monkeypatch.setattr(type(wanted.scene), "recordings", lambda self: ["train a 3", "test b 2"])
    Run.create(wanted)
    Run.open(tmp_path / "run").check_recordings()
    (tmp_path / "other" / "checkpoints" / "4").mkdir(parents=True)
    with pytest.raises(UsageError, match="exists.*--resume"):
        Run.create(settings("bc", tmp_path / "other"))


def test_an_existing_run_is_never_overwritten(whole):
    before = (whole.folder / "metrics.jsonl").read_bytes()
    with pytest.raises(UsageError, match="exists.*--resume"):
        train.train(whole.config)
    assert (whole.folder / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (["--method", "mgail"], "mgail.*is of method rtc_c"),
        (["--updates", "50"], "updates 50.*has 40"),
        (["--scene.steps", "20"], r"scene\.steps 20.*has 16"),
        (["--scene", "elsewhere"], "elsewhere.*double_goal"),
    ],
)
def test_resuming_with_other_settings_is_refused(whole, argv, named):
    refused(["--run", str(whole.folder), "--resume", *argv], named)


def test_incomplete_and_damaged_runs_are_refused(whole, tmp_path):
    refused(["--run", str(tmp_path), "--resume"], "not a run directory")
    run = copy(whole, tmp_path)
    (run.folder / "config.json").write_text("{")
    refused(["--run", str(run.folder), "--resume"], "config.json is damaged")
    (run.folder / "config.json").write_text(json.dumps({"scene": {"name": "double_goal", "steps": "x"}}))
    refused(["--run", str(run.folder), "--resume"], "steps.*'x'")
    (run.folder / "config.json").write_text(json.dumps(json.loads((whole.folder / "config.json").read_text()) | {"batch": 0}))
    with pytest.raises(UsageError, match=r"config\.json: --batch 0: at least 4"):
        Run.open(run.folder)


@pytest.mark.parametrize(
    ("main", "argv", "named"),
    [
        (evaluate.main, ["--run", "RUN", "--episodes", "1"], "episodes 1"),
        (evaluate.main, ["--run", "/nowhere"], "nowhere is not a run"),
        (render.main, ["--run", "RUN", "--camera", "rear"], "rear.*top"),
        (render.main, ["--run", "RUN", "--out", "film.gif"], r"film\.gif.*\.mp4"),
        (render.main, ["--run", "RUN", "--seed", "2"], "seed 2.*0 to 1"),
        (render.main, ["--run", "RUN", "--size", "33x5"], "33x5"),
        (render.main, ["--run", "RUN", "--types", "0"], "types 0"),
        (populations.main, ["RUN", "--out", "picture.jpg"], r"picture\.jpg.*\.png"),
        (populations.main, ["RUN", "--out", "picture.png", "--seed", "2"], "seed 2.*0 to 1"),
        (populations.main, ["RUN", "RUN", "--out", "picture.png"], "one run a method"),
        (populations.main, ["RUN", "--out", "picture.png", "--agents", "0"], "agents 0"),
        (report.main, ["/nowhere", "--out", "x"], "nowhere is not a run"),
        (report.main, ["/nowhere"], "nowhere: no such folder"),
    ],
)
def test_commands_refuse_wrong_use_in_one_line(main, argv, named, whole):
    with pytest.raises(UsageError, match=named) as caught:
        main([str(whole.folder) if word == "RUN" else word for word in argv])
    assert "\n" not in str(caught.value)


def test_evaluation_of_a_run_without_a_checkpoint_is_refused(tmp_path, monkeypatch):
    """Before anything is made for it."""
    run = Run.create(settings("bc", tmp_path / "run"))
    monkeypatch.setattr(dataset, "demonstrations", None)
    with pytest.raises(UsageError, match="no whole checkpoint"):
        evaluate.evaluate(run, 16)


def test_exit_statuses(tmp_path):
    """2 and one line for wrong use; the progress of a run without a terminal is plain lines."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    wrong = subprocess.run([sys.executable, "-m", "rtc_mjx.train", "--updates", "0"], env=env, capture_output=True, text=True, timeout=100)
    assert wrong.returncode == 2 and wrong.stderr.count("\n") == 1 and not wrong.stdout
    right = [
        sys.executable,
        "-W",
        "error",
        "-m",
        "rtc_mjx.train",
        "--method",
        "bc",
        *SMALL,
        "--updates",
        "20",
        "--run",
        str(tmp_path / "r"),
    ]
    done = subprocess.run(right, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^update 20/20 .*return", done.stderr, re.M) and "\x1b" not in done.stderr + done.stdout
    assert "expert" in done.stdout and jax.tree.leaves(json.loads((tmp_path / "r" / "evaluation.json").read_text()))


def test_a_run_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "r").write_text("mine")
    with pytest.raises(UsageError, match="is a file"):
        Run.create(settings("bc", tmp_path / "r"))
    assert (tmp_path / "r").read_text() == "mine"


def test_settings_that_lack_a_key_are_not_completed_with_todays_defaults(tmp_path):
    config.write(settings("bc"), tmp_path)
    table = json.loads((tmp_path / "config.json").read_text())
    del table["losses"]["type_kl"]
    (tmp_path / "config.json").write_text(json.dumps(table))
    with pytest.raises(UsageError, match="lacks losses.type_kl"):
        config.read(tmp_path)


@pytest.mark.parametrize("method", ON_SCENE)
def test_a_run_may_lack_later_settings_that_its_method_does_not_read(method, tmp_path):
    held = settings(method)
    config.write(held, tmp_path)
    table = json.loads((tmp_path / "config.json").read_text())
    for name in (*config.OF_VALUE, *config.OF_RECOVERY, "model.posterior_components", "losses.discriminator_penalty_agent", "losses.fakes"):
        section, key = name.split(".")
        del table[section][key]
    (tmp_path / "config.json").write_text(json.dumps(table))
    if method == "gail":
        with pytest.raises(UsageError, match="lacks losses.policy_gradient"):
            config.read(tmp_path)
    else:
        assert config.read(tmp_path) == dataclasses.replace(held, run=tmp_path)
