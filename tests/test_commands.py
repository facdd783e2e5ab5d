"""Commands: what they print, write and refuse."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from rtc_mjx import benchmark, config, experts, study
from rtc_mjx.config import command_line
from rtc_mjx.errors import UsageError

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def rows(optimised):
    world = benchmark.WORLDS["point_mass"]()
    return [r for d in benchmark.DIRECTIONS for r in benchmark.measure("point_mass", world, 16, d, rounds=1)]


def test_every_variant_and_direction_is_measured(rows):
    assert {(r.variant, r.direction) for r in rows} == {(v, d) for v in benchmark.VARIANTS for d in benchmark.DIRECTIONS}
    assert all(r.steps_per_s > 0 and r.compile_s > 0 and r.temp_mb >= 0 for r in rows)


def test_specialising_is_worth_it(rows):
    """Far below what the benchmark measures, so that a busy machine does not fail it."""
    rate = {(r.variant, r.direction): r.steps_per_s for r in rows}
    assert rate["specialised", "gradient"] > 5 * rate["native", "gradient"]


def test_whole_updates_are_measured_on_both_physics():
    held = benchmark.updates("double_goal", "mgail", rounds=1, seed_counts=(1,))
    assert {r["physics"] for r in held} == {"mjx", "handwritten"} and all(r["ms"] > 0 for r in held)
    assert benchmark.updates_table(held).row_count == 2


def test_the_figure_is_drawn(rows, tmp_path):
    benchmark.figure(rows, tmp_path / "speed.png")
    assert (tmp_path / "speed.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", benchmark.WORLDS)
def test_hand_written_equations_do_what_the_world_does(name):
    """The floor must be the same problem: a gently driven point mass or car ends where its equations say."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    world = benchmark.WORLDS[name]()
    floor = benchmark.handwritten_rollout(world)
    if floor is None:
        assert world.users
        return
    state, controls, around = benchmark.random_inputs(world, 1, benchmark.STEPS)
    state, controls, around = jax.tree.map(lambda x: x[0], (state, controls * 0.04, around))
    if world.mj.nv == 4:
        state = type(state)(jnp.zeros(4), jnp.array([5.0, 0, 0, 0]), state.warmstart)
    ours = benchmark.our_rollout(world, specialised=False)(state, controls, around)
    assert np.allclose(floor(state, controls, around)[:2], ours[:2], atol=0.02 * (1 + np.max(np.abs(ours))))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--worlds", "moon"], "no world 'moon'.*point_mass, car, car_8"),
        (["--batches", "16,x"], "--batches 16,x"),
        (["--batches", "0"], "--batches 0"),
        (["--rounds", "0"], "--rounds 0"),
        (["--json", "/nowhere/at/all.json"], "--json /nowhere/at"),
        (["--json", "/"], "--json /: a file name"),
        (["--json", ""], "a file name"),
        (["--scaling-on", "0"], "--scaling-on 0: at least 1"),
        (["--figure", "speed.foo"], "--figure speed.foo: a file name that ends in .png"),
    ],
)
def test_wrong_options_are_refused_in_one_line(options, named):
    with pytest.raises(UsageError, match=named):
        benchmark.main(options)


def test_wrong_use_leaves_with_status_2_and_one_line():
    for options in (["--worlds", "moon"], ["--quik"], ["--quic"]):  # nothing is guessed from the beginning of an option
        done = subprocess.run([sys.executable, "-m", "rtc_mjx.benchmark", *options], capture_output=True, text=True, cwd=ROOT, check=False)
        assert done.returncode == 2
        assert len(done.stderr.strip().splitlines()) == 1
        assert options[-1] in done.stderr


def test_a_message_in_colours_is_one_plain_line():
    red, plain = "\x1b[31m", "\x1b[0m"
    lines = ["╭─ Unrecognized options ─╮", "│ Unrecognized options: --sceen │", "│ ───── │", "│ --seeds INT │"]
    boxed = "\n".join(f"{red}{line}{plain}" for line in lines).replace("--", f"{red}--{plain}")
    told = command_line._one_line(boxed, "train")
    assert told == "train: Unrecognized options: --sceen; near it: --seeds (see --help)"


@pytest.mark.parametrize(
    ("command", "options", "named"),
    [
        (study, ["--results", "out", "--method", "rtc"], "--method is not an option here; name methods with --methods"),
        (study, ["--results", "out", "--run=runs/x"], "--run is not an option here; --runs DIR"),
        (study, ["--results", "out", "--name", ".."], "--name ..: a name is needed"),
        (experts, ["--method", "rtc"], "--method is not an option here"),
        (experts, ["--seeds", "4"], "--seeds is not an option here; those of the scene are"),
    ],
)
def test_options_of_one_training_are_no_options_of_a_study(command, options, named):
    """They would be taken for those of every entry: all methods would be one."""
    with pytest.raises(UsageError, match=named):
        command.main(["--scene", "double_goal", *options])


def test_what_experts_do_is_told_with_intervals(capsys):
    experts.main(["--scene", "double_goal", "--episodes", "64", "--scene.steps", "20"])
    table = dict(line.split("│")[1:3] for line in capsys.readouterr().out.splitlines() if line.startswith("│"))
    assert {name.strip() for name in table} == {"return", "jsd_goal", "jsd_goal_and_turn", "lower"}
    found, notes = experts.told(config.from_command_line(["--scene", "double_goal", "--scene.steps", "20", "--experts.test", "64"], "told"))
    assert all(low <= value <= high for value, low, high, _ in found.values()) and not notes
    assert {name.strip(): float(value) for name, value in table.items()} == pytest.approx({n: v[0] for n, v in found.items()}, rel=1e-3)
    with pytest.raises(UsageError, match="episodes 1"):
        experts.main(["--scene", "double_goal", "--episodes", "1"])


def test_help_explains_and_nothing_else_is_printed():
    done = subprocess.run([sys.executable, "-m", "rtc_mjx.benchmark", "--help"], capture_output=True, text=True, cwd=ROOT, check=True)
    assert "--quick" in done.stdout and done.stderr == ""


def test_rows_survive_json(rows):
    assert json.loads(json.dumps([vars(r) for r in rows]))[0]["world"] == "point_mass"


def test_the_lock_file_holds_versions_and_no_addresses():
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    assert lines and not any("://" in line or "@" in line for line in lines)
