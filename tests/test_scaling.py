"""One training on any number of devices and processes: the same numbers, one run directory, and nobody waits for who is gone."""

import contextlib
import dataclasses
import functools
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning import begin, experts, learner, settings

from rtc_mjx import cluster, config, train
from rtc_mjx.cluster import Hardware
from rtc_mjx.errors import RunError, UsageError
from rtc_mjx.losses import LossWeights
from rtc_mjx.runs import Run
from rtc_mjx.sharding import ALL_ROWS, BATCH, Rows, grid
from rtc_mjx.team import HELLO_S, Place, Team, meet
from rtc_mjx.updates import train_step

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S = 240  # of a subprocess: it must end by itself long before
TIMEOUT_S = 10  # --timeout of the trainings here


# How rows and seeds are shared out


@pytest.mark.parametrize("sizes", [(12,), (4, 8), (8, 0, 4), (5, 9), (1, 2)])
def test_every_row_counts_on_one_device_and_every_device_has_an_equal_share_of_each_branch(sizes):
    def share(_):
        mine = Rows(4).mine(jnp.arange(sum(sizes)), *sizes)
        return mine, Rows(4).counting(mine >= 0, *sizes)

    mine, counts = jax.vmap(share, axis_name=BATCH)(jnp.arange(4))
    assert sorted(np.asarray(mine)[np.asarray(counts)]) == list(range(sum(sizes)))
    edges = np.cumsum([0, *sizes])
    for rows in np.asarray(mine):
        assert [np.sum((rows >= a) & (rows < b)) for a, b in zip(edges, edges[1:], strict=False)] == [-(-size // 4) for size in sizes]


@pytest.mark.parametrize(("method", "fakes"), [("rtc_c", "all"), ("rtc_c", "test"), ("gail", "all")])
def test_an_update_shared_out_is_that_of_one_device(method, fakes, x64):
    """In double precision, where the order of a sum is all that may differ: rtc's branches of four rows and of eight, on five devices."""
    weights, parts = LossWeights(adversarial_ramp=0, discriminator_penalty_agent=0.1, fakes=fakes), 5
    held = learner(method, share=1 / 3, weights=weights)
    state, _ = begin(held)
    alone, told = jax.jit(one_update(held, 1))(state)
    together, told_together = jax.jit(jax.vmap(one_update(held, parts), in_axes=None, axis_name=BATCH, axis_size=parts))(state)
    for ours, theirs in zip(jax.tree.leaves(together.networks), jax.tree.leaves(alone.networks), strict=True):
        assert np.array_equal(ours[0], ours[-1])  # on all devices the same
        assert np.allclose(ours[0], theirs, rtol=1e-9, atol=1e-12)
    assert set(told) == set(told_together)
    for name, value in told.items():
        assert float(told_together[name][0]) == pytest.approx(float(value), rel=1e-6), name  # some are means of bools, in float32


def one_update(held, parts):
    """An update of a learner whose minibatch is shared out."""
    shared = dataclasses.replace(held, shared=Rows(parts), optimiser=dataclasses.replace(held.optimiser, trajectory_clip=1e-3))
    return lambda state: train_step(shared, state, experts(True))


@pytest.mark.parametrize(
    ("devices", "seeds", "branches", "shape"),
    [
        (1, 3, (64,), (1, 1)),
        (4, 4, (24, 40), (4, 1)),  # seeds first: they need no word between devices
        (8, 20, (24, 40), (4, 2)),
        (8, 1, (24, 40), (1, 8)),
        (8, 1, (19, 45), (1, 8)),
        (6, 4, (24, 40), (2, 3)),
        (3, 4, (64,), (1, 3)),
        (6, 1, (3, 5), None),
        (7, 4, (4,), None),
    ],
)
def test_seeds_are_spread_first_and_minibatches_over_what_is_left(devices, seeds, branches, shape):
    names = [f"device {i}" for i in range(devices)]
    if shape is None:
        with pytest.raises(UsageError, match=rf"^{devices} devices.*--seeds {seeds}.*can be used: 1, 2") as caught:
            grid(names, seeds, branches, wanted=devices)
        assert "\n" not in str(caught.value)
        return
    made = grid(names, seeds, branches, wanted=devices)
    assert (made.mesh.devices.shape if made.mesh else (1, 1)) == shape


def test_without_being_told_as_many_devices_are_used_as_the_work_divides_among():
    assert grid(list("abcdefg"), 4, (24, 40)).mesh.devices.shape == (1, 7)
    assert grid(list("abcdefg"), 2, (2,)).mesh.devices.shape == (2, 2)
    assert grid(list("a"), 2, (2,)).mesh is None


def test_one_device_runs_the_program_that_knows_of_no_others():
    """Sharing out among one adds no operation to an update."""
    held = learner("rtc_c")
    state, _ = begin(held)
    text = jax.jit(lambda s: train_step(held, s, experts(False))).lower(state).as_text()
    assert held.shared == ALL_ROWS and "all_reduce" not in text and "partition_id" not in text


# Processes that meet


def together(*parts):
    """What functions return, or the errors they end with, when they run at the same time."""
    ends = queue.SimpleQueue()

    def run(index, part):
        try:
            ends.put((index, part()))
        except (UsageError, RunError) as error:
            ends.put((index, error))

    for index, part in enumerate(parts):
        threading.Thread(target=run, args=(index, part), daemon=True).start()
    return [end for _, end in sorted((ends.get(timeout=30) for _ in parts), key=lambda pair: pair[0])]


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as held:
        return held.getsockname()[1]


def meeting(port, process, count, told=(), patience=TIMEOUT_S):
    return functools.partial(meet, Place("127.0.0.1", port, process, count), dict(told), patience)


def close(teams):
    for team in teams:
        for link in team.links.values():
            link.close()


def test_processes_that_agree_meet_and_exchange_what_they_have():
    port = free_port()
    teams = together(*(meeting(port, process, 3, {"--batch": 64}) for process in range(3)))
    assert [team.leads for team in teams] == [True, False, False] and teams[2].name(1) == f"process 1 ({socket.gethostname()})"
    for team in teams:
        team.watch()
    for value in ("a", [1.5, None]):  # more than once, and in the order of processes
        all_values = [[value, i] for i in range(3)]
        assert together(*(functools.partial(team.exchange, [value, team.process]) for team in teams)) == [all_values] * 3
    together(*(functools.partial(team.exchange, None, last=True) for team in teams))
    close(teams)  # after the last exchange nobody minds
    time.sleep(0.5)
    assert Team().exchange(3) == [3]


@pytest.mark.parametrize(
    ("others", "named"),
    [
        ([(1, 2, {"--batch": 32})], r"^process 1 .* has --batch 32, process 0 .* has 64"),
        ([(1, 2, {"--batch": 64, "jax": "0.1"})], r"process 1 .* has jax 0\.1, process 0 .* has None"),
        ([(1, 3, {"--batch": 64})], r"--process-count 3.*has 2"),
    ],
)
def test_processes_that_differ_all_say_so_in_one_line(others, named):
    port = free_port()
    ends = together(meeting(port, 0, 2, {"--batch": 64}), *(meeting(port, *other) for other in others))
    assert len({str(end) for end in ends}) == 1
    for end in ends:
        assert isinstance(end, UsageError) and "\n" not in str(end)
        with pytest.raises(UsageError, match=named):
            raise end


def test_a_process_that_falls_silent_ends_the_others(monkeypatch, capsys):
    """It hangs, or its machine is gone: its line stays open, and nothing comes."""
    port, ends = free_port(), queue.SimpleQueue()
    monkeypatch.setattr("rtc_mjx.team.leave", ends.put)
    first, silent = together(meeting(port, 0, 2, patience=1), meeting(port, 1, 2, patience=1))
    first.watch()
    assert ends.get(timeout=10) == 1
    assert f"{first.name(1)} has not been heard of for 1 s; all processes stop, --resume goes on" in capsys.readouterr().err
    close([first, silent])


class Unread:
    """What a process writes to where nobody reads any more: a full disk, a closed terminal."""

    def write(self, text):
        raise OSError(28, "No space left on device")

    flush = write


def test_a_process_ends_though_it_cannot_say_why(monkeypatch):
    port, ends = free_port(), queue.SimpleQueue()
    monkeypatch.setattr("rtc_mjx.team.leave", ends.put)
    first, gone = together(meeting(port, 0, 2), meeting(port, 1, 2))
    monkeypatch.setattr(sys, "stderr", Unread())
    first.watch()
    close([gone])
    assert ends.get(timeout=10) == 1
    close([first])


def test_processes_with_unequal_numbers_of_devices_are_named():
    class Pair(Team):
        def exchange(self, value, last=False):
            return [value, value + 1]

    with pytest.raises(UsageError, match=r"^process 1 \(there\) has 2 devices, process 0 \(here\) 1"):
        train.devices(small(None), Pair(hosts=("here", "there")))


def test_two_processes_of_one_number_are_refused():
    port = free_port()
    ends = together(meeting(port, 0, 3), meeting(port, 1, 3), meeting(port, 1, 3))
    assert all(isinstance(end, UsageError) and "--process-id 1" in str(end) for end in ends)


def test_who_does_not_come_is_named_and_nobody_waits_longer_than_was_said():
    port, begun = free_port(), time.monotonic()
    ends = together(meeting(port, 0, 3, patience=2), meeting(port, 1, 3, patience=2))
    assert all(isinstance(end, RunError) and "process 2 did not come within 2 s" in str(end) for end in ends)
    assert time.monotonic() - begun < 10


@pytest.mark.parametrize("listener", [None, "garbage", "silence"])
def test_a_coordinator_that_cannot_be_reached_is_named(listener):
    """Nothing listens, or something that speaks another language, or nothing at all."""
    with contextlib.ExitStack() as stack:
        port = free_port()

        def greet(held):
            with held.accept()[0] as line:
                line.sendall(b"SSH-2.0-hello\n")

        if listener:
            held = stack.enter_context(socket.create_server(("127.0.0.1", port)))
            if listener == "garbage":
                threading.Thread(target=greet, args=(held,), daemon=True).start()
        begun = time.monotonic()
        with pytest.raises(UsageError, match=rf"^--coordinator 127\.0\.0\.1:{port}: cannot be reached within 2 s"):
            meeting(port, 1, 2, patience=2)()
        assert time.monotonic() - begun < 2 + 2 * HELLO_S


def test_a_stranger_at_the_door_is_not_counted():
    port = free_port()

    def stranger():
        for text in (b"GET / HTTP/1.1\r\n\r\n", b'{"process": 1}\n', b"[]\n"):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)) as line:
                line.sendall(text)
        return meeting(port, 1, 2)()

    teams = together(meeting(port, 0, 2), stranger)
    assert [team.process for team in teams] == [0, 1]
    close(teams)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (Hardware(distributed=True), "no job of Slurm.*--coordinator HOST:PORT, --process-count, --process-id"),
        (Hardware(distributed=True, coordinator="here", process_id=0, process_count=2), "--coordinator here: HOST:PORT"),
        (Hardware(distributed=True, coordinator="here:99999", process_id=0, process_count=2), "--coordinator here:99999"),
        (Hardware(distributed=True, coordinator="here:1234", process_id=2, process_count=2), "--process-id 2"),
    ],
)
def test_impossible_places_are_refused(options, named, monkeypatch):
    for name in [name for name in os.environ if name.startswith(("SLURM_", "OMPI_", "KUBERNETES_", "JAX_COORDINATOR"))]:
        monkeypatch.delenv(name)
    with pytest.raises(UsageError, match=named):
        cluster.place(options)


def test_slurm_says_where_a_process_stands(monkeypatch):
    job = {"JOB_ID": "4096", "STEP_NODELIST": "node[07-09]", "NTASKS": "3", "PROCID": "2", "LOCALID": "0"}
    for name, value in job.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    here = cluster.place(Hardware(distributed=True))
    assert (here.host, here.process, here.count) == ("node07", 2, 3) and here.port > 1024
    assert cluster.place(Hardware(distributed=True, coordinator="other:1234")).address == "other:1234"
    assert cluster.place(Hardware(distributed=True, coordinator="[::1]:1234")).address == "[::1]:1234"
    assert list(here.local_devices) == [0]
    monkeypatch.setenv("JAX_LOCAL_DEVICE_IDS", "2,3")
    assert cluster.place(Hardware(distributed=True)).local_devices == [2, 3]


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (["--devices", "0"], "--devices 0"),
        (["--devices", "2", "--distributed"], "--devices 2.*all devices"),
        (["--process-id", "1"], "--process-id 1.*--distributed"),
        (["--timeout", "1"], "--timeout 1.*5"),
    ],
)
def test_wrong_options_are_refused_in_one_line(argv, named):
    with pytest.raises(UsageError, match=named) as caught:
        config.from_command_line(argv, "train")
    assert "\n" not in str(caught.value)


def test_where_a_training_ran_is_not_written_down():
    """A run goes on anywhere: nothing of the machine is among its settings."""
    here = settings("bc", hardware=Hardware(devices=3))
    assert config.to_dict(here) == config.to_dict(settings("bc"))


# Whole trainings, in processes of their own

SMALL = ["--scene", "double_goal", "--method", "rtc", "--scene.steps", "16", "--batch", "16", "--model.width", "16", "--updates", "8"]
SMALL += ["--model.discriminator-width", "16", "--model.type-size", "3", "--model.prior-components", "3", "--encoder-share", "0.25"]
SMALL += ["--experts.train", "64", "--experts.test", "16", "--every.log", "2", "--every.test", "4", "--every.save", "2", "--seeds", "2"]


def environment(devices=1):
    return {**os.environ, "PYTHONPATH": str(ROOT), "JAX_NUM_CPU_DEVICES": str(devices), "JAX_PLATFORMS": "cpu"}


def run_script(code, *argv, devices=1):
    """A Python script with its own devices."""
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, argv)]
    done = subprocess.run(command, env=environment(devices), capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, done.stderr


def small(folder, *more):
    """A small training's settings."""
    return config.from_command_line([*SMALL, "--run", str(folder), *more], "test")


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The training on one device."""
    return train.train(small(tmp_path_factory.mktemp("alone") / "run"))


def differs(run, other):
    """The largest difference between what two runs logged; the metrics of tests count steps and are left out."""
    pairs = list(zip(run.metrics(), other.metrics(), strict=True))
    assert pairs and all(set(ours) == set(theirs) for ours, theirs in pairs)
    names = [name for name, value in pairs[0][0].items() if isinstance(value, list)]
    return max(np.max(np.abs(np.subtract(ours[name], theirs[name]))) for ours, theirs in pairs for name in names)


STOPPED = """
    import dataclasses, sys
    from rtc_mjx import cache, config, train
    from rtc_mjx.runs import Run

    cache.keep_compiled()
    folder, first, then, argv = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
    saved = Run.save

    def stop(run, update, state, wall_s):
        saved(run, update, state, wall_s)
        if update == 4:
            raise KeyboardInterrupt

    Run.save = stop
    try:
        train.train(config.from_command_line([*argv, "--run", folder, "--devices", str(first)], "test"))
    except KeyboardInterrupt:
        pass
    Run.save = saved
    train.train(config.from_command_line(["--run", folder, "--resume", "--devices", str(then)], "test"))
"""


def test_any_number_of_devices_gives_the_numbers_of_one_and_a_run_goes_on_on_another(alone, tmp_path):
    """Four simulated devices, two seeds: a mesh of two by two; from update 4 on two devices."""
    run_script(STOPPED, tmp_path / "run", 4, 2, *SMALL, devices=4)
    assert differs(Run.open(tmp_path / "run"), alone) < 1e-5


def test_more_devices_than_there_is_work_for_are_refused_or_left_out(tmp_path):
    """One episode of the minibatch goes to one branch, three to the other: a fourth device would have nothing to do."""
    code = """
        import sys
        from rtc_mjx import cli, config, train
        from rtc_mjx.team import ALONE

        held = config.from_command_line(sys.argv[1:], "test")
        assert train.devices(held, ALONE).mesh.shape == {"seed": 1, "batch": 3}
        cli.run(lambda _: train.main([*sys.argv[1:], "--devices", "4"]))
    """
    command = [sys.executable, "-c", textwrap.dedent(code), *SMALL, "--seeds", "1", "--batch", "4", "--run", str(tmp_path / "run")]
    done = subprocess.run(command, env=environment(4), capture_output=True, text=True, timeout=LIMIT_S)
    assert not (tmp_path / "run").exists()
    told, refused = done.stderr.splitlines()
    assert done.returncode == 2 and "3 of 4 devices are used" in told and "can be used: 1, 2, 3" in refused


class Process:
    """A process of a training, with what it wrote."""

    def __init__(self, log, code, *argv):
        self.log = log
        with log.open("w") as file:
            command = [sys.executable, "-c", textwrap.dedent(code), *map(str, argv)]
            self.child = subprocess.Popen(command, env=environment(), stdout=file, stderr=file)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.child.kill()
        self.child.wait()

    def status(self, limit=LIMIT_S):
        return self.child.wait(timeout=limit)

    def text(self):
        return self.log.read_text()


TRAINING = """
    import os, signal, sys
    import jax
    from rtc_mjx import cli, train

    victim = int(sys.argv[1])
    finite, trained = train.check_finite, train.train

    def first_alone(config, team):
        if team.leads:
            jax.numpy.zeros(1) + 1  # as where it measures what is there: it needs devices before the others do
        team.exchange(None)
        return trained(config, team)

    def die(line, run):
        if line["update"] == victim:
            os.kill(os.getpid(), signal.SIGKILL)
        finite(line, run)

    train.check_finite, train.train = die, first_alone
    cli.run(lambda _: train.main(sys.argv[2:]))
"""


def pair(tmp_path, name, code, argv, *, victims=(0, 0)):
    """Two processes that train together, the first first; a victim kills itself after an update."""
    where = ["--distributed", "--coordinator", f"127.0.0.1:{free_port()}", "--process-count", "2", "--timeout", str(TIMEOUT_S)]
    logs = [tmp_path / f"{name}_{process}.log" for process in range(2)]
    return [Process(logs[i], code, victims[i], *argv, *where, "--process-id", i) for i in range(2)]


def test_a_process_that_dies_is_named_in_time_and_the_run_goes_on_to_the_same_numbers(tmp_path):
    """One seed, so that every gradient is summed over two processes; the second is killed, then both go on, to a run on one device."""
    quick, folder = ["--method", "mgail", "--scene.steps", "8", "--seeds", "1", "--every.test", "8"], tmp_path / "run"
    first, second = pair(tmp_path, "first", TRAINING, [*SMALL, *quick, "--run", folder], victims=(0, 6))
    with first, second:
        assert second.status() == -signal.SIGKILL
        died = time.monotonic()
        assert first.status() == 1, first.text()
        assert time.monotonic() - died < TIMEOUT_S
    last = first.text().splitlines()[-1]
    assert last.startswith(f"process 1 ({socket.gethostname()}) is gone") and "--resume" in last
    assert max(Run.open(folder).checkpoints()) == 4
    first, second = pair(tmp_path, "second", TRAINING, ["--run", folder, "--resume"])
    with first, second:
        assert (first.status(), second.status()) == (0, 0), first.text() + second.text()
    run = Run.open(folder)
    assert [line["update"] for line in run.metrics()] == [2, 4, 6, 8] and list(run.checkpoints()) == [8, 6, 4]
    assert "update 8/8" in first.text() and "update" not in second.text()  # one shows, one writes
    assert json.loads((folder / "evaluation.json").read_text())["update"] == 8
    assert differs(run, train.train(small(tmp_path / "alone", *quick))) < 1e-5


WAITING = """
    import sys, time
    from rtc_mjx import cli, cluster, config

    def main(_):
        held = config.from_command_line(sys.argv[2:], "test")
        with cluster.joined(held.hardware, {}) as team:
            print("joined", flush=True)
            if int(sys.argv[1]) == team.process:
                raise RuntimeError("the disk is full")
            team.exchange(None)

    cli.run(main)
"""


def test_a_coordinator_that_dies_is_named(tmp_path):
    first, second = pair(tmp_path, "run", WAITING.replace("team.exchange(None)", "time.sleep(100)"), SMALL, victims=(9, 9))
    with first, second:
        deadline = time.monotonic() + LIMIT_S
        while not all("joined" in process.text() for process in (first, second)) and time.monotonic() < deadline:
            time.sleep(0.1)
        first.child.kill()
        died = time.monotonic()
        assert second.status(60) == 1
        assert time.monotonic() - died < 2 * TIMEOUT_S
    said = second.text().splitlines()  # JAX's runtime notices as well, and may write below
    assert any("process 0 (" in line and "gone" in line for line in said), said


def test_a_process_that_fails_says_why_to_the_others(tmp_path):
    first, second = pair(tmp_path, "run", WAITING, SMALL, victims=(1, 1))
    with first, second:
        assert (first.status(60), second.status(60)) == (1, 1)
    assert f"process 1 ({socket.gethostname()}) stops: the disk is full" in first.text()
