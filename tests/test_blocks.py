"""More seeds for a study: those that are there are kept, those missing are trained, and the whole is what training at once makes."""

import contextlib
import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from test_study import SMALL, command

from rtc_mjx import blocks, config, entry, evaluate, provenance, study, train, type_shift
from rtc_mjx.errors import UsageError
from rtc_mjx.runs import TRAINED_BY, Run
from rtc_mjx.trained import restored


def bc(place):
    return place / "runs" / "double_goal" / "bc"


def complete(place, seeds, *more):
    """A study's training of so many seeds, evaluated."""
    return entry.complete(entry.Entry("bc", "bc", ("--seeds", str(seeds), *SMALL)), "double_goal", bc(place), *more, analysed=False)


def found(run):
    """All that is known of a run, without how long it took; its state as bytes."""
    lines = [{k: v for k, v in line.items() if k != "wall_s"} for line in run.metrics()]
    _, update, state, _ = restored(run)
    numbers = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state)]
    return config.to_dict(run.config), lines, json.loads((run.folder / "evaluation.json").read_text()), update, numbers


@pytest.fixture
def told(extended, monkeypatch):
    """What the runs of a test are found to do is known: an evaluation takes seconds."""
    known = bc(extended) / "evaluation.json"
    monkeypatch.setattr(evaluate, "main", lambda argv: shutil.copy(known, argv[1]))


@pytest.fixture(scope="module")
def some(tmp_path_factory):
    """Seeds 0 and 1 of a study."""
    place = tmp_path_factory.mktemp("some")
    complete(place, 2)
    return place


@pytest.fixture(scope="module")
def extended(some, tmp_path_factory):
    """The same study, gone on with to seed 2."""
    place = Path(shutil.copytree(some, tmp_path_factory.mktemp("extended") / "study"))
    with pytest.MonkeyPatch.context() as patched:
        trained = watched(patched)
        patched.setattr(type_shift, "main", lambda argv: (_ for _ in ()).throw(UsageError("it takes seconds")))
        study.main(command(place, "bc", seeds=3))
    assert trained == [range(2, 3)]  # only what is missing
    return place


@pytest.fixture
def again(some, tmp_path):
    """A copy of seeds 0 and 1 to go on with."""
    return Path(shutil.copytree(some, tmp_path / "again"))


def watched(patched):
    """The seeds of every training from now on."""
    seen, really = [], train.train
    patched.setattr(train, "train", lambda wanted, *more: seen.append(wanted.all_seeds) or really(wanted, *more))
    return seen


def begun(place, seeds, updates=4, **changes):
    """A run that has its settings and nothing else."""
    wanted = entry.resolved(entry.Entry("bc", "bc", tuple(SMALL)), "double_goal")
    return Run.create(dataclasses.replace(blocks.part(wanted, seeds, place), updates=updates, **changes))


def alike(ours, theirs, where=""):
    """Numbers wherever they stand are equal to rounding, all else is equal."""
    if isinstance(ours, dict):
        assert set(ours) == set(theirs), where
        for key in ours:
            alike(ours[key], theirs[key], f"{where}/{key}")
    elif isinstance(ours, list | tuple):
        assert len(ours) == len(theirs), where
        for i, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            alike(one, other, f"{where}/{i}")
    else:
        assert ours == (pytest.approx(theirs, rel=1e-3, abs=1e-4) if isinstance(theirs, float) else theirs), where


def test_seeds_joined_are_those_trained_at_once(extended, tmp_path):
    joined, whole = Run.open(bc(extended)), complete(tmp_path, 3)
    alike(found(joined)[:4], found(whole)[:4])
    (_, update, state, _), (_, _, other, _) = restored(joined), restored(whole)
    assert update == 4 and state.seed.tolist() == [0, 1, 2] and jax.tree.structure(state) == jax.tree.structure(other)
    for ours, theirs in zip(jax.tree.leaves(state), jax.tree.leaves(other), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-5)
    assert len(json.loads((extended / "double_goal" / "bc.json").read_text())["metrics"]["return"]["per_seed"]) == 3


def test_a_joined_run_keeps_its_blocks_and_can_be_resumed(extended, some):
    joined = Run.open(bc(extended))
    kept = {part.name: Run.open(part) for part in (joined.folder / "blocks").iterdir()}
    assert {name: run.config.all_seeds for name, run in kept.items()} == {"seeds_0_1": range(2), "seeds_2_2": range(2, 3)}
    assert list(kept["seeds_0_1"].checkpoints()) == [4, 2] and kept["seeds_0_1"].metrics() == Run.open(bc(some)).metrics()
    for run in kept.values():
        assert any("events" in file.name for file in run.folder.iterdir())
    assert joined.metrics()[-1]["wall_s"] == sum(run.metrics()[-1]["wall_s"] for run in kept.values())
    before = joined.metrics_file.read_text()
    assert train.train(dataclasses.replace(joined.config, resume=True)).metrics_file.read_text() == before
    assert {part.name for part in joined.folder.parent.iterdir()} == {"bc", "blocks", ".lock"}


@contextlib.contextmanager
def stopped(where, patched):
    """What is under way is stopped at a place, as by a signal that cannot be caught."""

    def stop(*_, **__):
        raise KeyboardInterrupt

    if isinstance(where, tuple):
        patched.setattr(*where, stop)
    else:
        name, on = where.split(" of ")
        owner = Path if name == "rename" else Run
        really = getattr(owner, name)

        def on_one(self, *rest):
            return stop() if getattr(self, "folder", self).name == on else really(self, *rest)

        patched.setattr(owner, name, on_one)
    with pytest.raises(KeyboardInterrupt):
        yield


STOPS = [
    "save of bc",  # its last checkpoint cannot be read: it is trained to its end first
    "save of joined",
    "rename of joined",  # no run of the entry stands there
    (evaluate, "main"),
    (blocks, "keep"),
    "rename of seeds_2_2",
]


def test_more_seeds_stopped_anywhere_end_like_those_that_were_not(again, extended, told, monkeypatch):
    for file in (bc(again) / "checkpoints" / "4" / "state").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    for where in STOPS:
        with monkeypatch.context() as patched, stopped(where, patched):
            complete(again, 3)
        assert set(study.collected([entry.Entry("mgail", "mgail")], "double_goal", bc(again).parent)) <= {"bc"}  # no block is an entry
    trained = watched(monkeypatch)
    run = complete(again, 3)
    assert not trained and found(run) == found(Run.open(bc(extended)))
    assert {part.name for part in (run.folder / "blocks").iterdir()} == {"seeds_0_1", "seeds_2_2"}


def test_seeds_missing_before_and_between_and_after_are_blocks(tmp_path):
    run = begun(tmp_path / "bc", range(4, 6))
    wanted = blocks.part(run.config, range(1, 12), run.folder)
    begun(blocks.place(run.folder, range(7, 9)), range(7, 9))
    begun(blocks.place(run.folder, range(12, 14)), range(12, 14))  # of a study that wanted more
    begun(blocks.place(run.folder, range(5, 8)), range(5, 8))  # its seeds are in others
    found = {part.all_seeds: part.folder.relative_to(tmp_path).as_posix() for part in blocks.to_join(wanted)}
    assert found == {
        range(1, 4): "blocks/bc/seeds_1_3", range(4, 6): "bc", range(6, 7): "blocks/bc/seeds_6_6",
        range(7, 9): "blocks/bc/seeds_7_8", range(9, 12): "blocks/bc/seeds_9_11",
    }  # fmt: skip
    assert list(found) == sorted(found, key=lambda seeds: seeds.start)
    assert blocks.to_join(run.config) == [] == blocks.to_join(dataclasses.replace(wanted, run=tmp_path / "mgail"))


@pytest.mark.parametrize(
    ("seeds", "options", "named"),
    [
        (1, [], "--first-seed 0 --seeds 1 is wanted.*seeds 0 to 1, .*give --first-seed 0 --seeds 2 "),
        (4, ["--first-seed", "1"], "--first-seed 1 --seeds 4 is wanted.*give --first-seed 0 --seeds 5 "),
        (4, ["--losses.cloning", "2.0"], r"--losses\.cloning 2\.0 is wanted.*has 1\.0"),
    ],
)
def test_seeds_that_would_have_to_go_and_other_settings_are_refused(again, seeds, options, named, monkeypatch):
    monkeypatch.setattr(study, "complete", lambda *_: pytest.fail("that is known before anything is trained"))
    with pytest.raises(UsageError, match=named):
        study.main(command(again, "bc", *options, seeds=seeds))


def test_blocks_that_wait_are_checked_before_anything_is_trained(again, monkeypatch):
    begun(blocks.place(bc(again), range(2, 6)), range(2, 6), updates=8)
    monkeypatch.setattr(train, "train", lambda *_: pytest.fail("that is known before anything is trained"))
    with pytest.raises(UsageError, match="--updates 4 is wanted: the run in .*seeds_2_5 has 8"):
        study.main(command(again, "bc", seeds=6))
    complete(again, 2)  # it has nothing to do with these
    assert blocks.place(bc(again), range(2, 6)).is_dir()


def test_a_result_of_some_seeds_does_not_replace_one_of_all(some):
    def shown(seeds):
        return set(study.collected([entry.Entry("bc", "bc", ("--seeds", str(seeds), *SMALL))], "double_goal", bc(some).parent))

    assert shown(2) == {"bc"} and shown(3) == set()


def test_what_is_not_blocks_of_one_training_is_not_joined(again, some, tmp_path):
    run = Run.open(bc(again))
    for seeds, changes, named in (
        (range(3, 4), {}, "begins with seed 3: 2 is needed"),
        (range(2, 4), {"batch": 16}, "has batch 16, .* has 8"),
        (range(2, 4), {}, r"lines of updates \[\], .*of \[2, 4\]"),
    ):
        with pytest.raises(UsageError, match=named):
            blocks.join([run, begun(tmp_path / "other", seeds, **changes)], tmp_path / "joined")
        shutil.rmtree(tmp_path / "other")
    shutil.rmtree(run.folder / "checkpoints" / "4")
    with pytest.raises(UsageError, match="no whole checkpoint of update 4"):
        blocks.join([run], tmp_path / "joined")
    assert not (tmp_path / "joined").exists()


def test_a_run_says_which_code_trained_it_and_a_joined_one_all_that_did(again, extended, tmp_path, capsys):
    now = provenance.code()
    run, later = Run.open(bc(again)), Run.open(bc(extended) / "blocks" / "seeds_2_2")
    assert run.trained_by() == later.trained_by() == Run.open(bc(extended)).trained_by() == [now]
    train.train(dataclasses.replace(run.config, resume=True))  # there is nothing left to train
    old = now | {"commit": "0ldc0de"}
    (run.folder / TRAINED_BY).write_text(json.dumps([old]))
    assert blocks.join([run, later], tmp_path / "joined").trained_by() == [old, now]
    assert f"were trained at 0ldc0de, {now['commit']}" in capsys.readouterr().err
    (run.folder / TRAINED_BY).unlink()  # of a version that did not write it
    assert blocks.trainers([run, later]) == [{"commit": None}, now] and "trained at None, " in capsys.readouterr().err
    (run.folder / TRAINED_BY).write_text(json.dumps([old]))
    shutil.rmtree(run.folder / "checkpoints" / "4")
    train.train(dataclasses.replace(run.config, resume=True))
    assert run.trained_by() == [old, now]
    (run.folder / TRAINED_BY).write_text("[1]")
    with pytest.raises(UsageError, match="trained_by.json is damaged"):
        run.trained_by()


def test_lines_of_all_seeds_hold_what_all_blocks_logged(capsys):
    one = [{"update": 2, "wall_s": 1.0, "env_steps": 5, "cloning": [1.0, 2.0], "old": [0.0, 0.0]}]
    other = [{"update": 2, "wall_s": 3.0, "env_steps": 5, "cloning": [3.0], "new": [0.0]}]
    assert blocks.joined_lines([one, other], ["a", "b"]) == [{"update": 2, "wall_s": 4.0, "env_steps": 5, "cloning": [1.0, 2.0, 3.0]}]
    assert "left out of what is joined: new, old" in capsys.readouterr().err
    with pytest.raises(UsageError, match="b, update 2: env_steps is 6, in a 5"):
        blocks.joined_lines([one, [other[0] | {"env_steps": 6}]], ["a", "b"])


def test_other_processes_train_the_same_blocks_and_write_nothing(again, extended, told, tmp_path, monkeypatch):
    said, seen = [], {True: [], False: []}

    def team(leads):
        values = iter(list(said))
        return SimpleNamespace(leads=leads, of_first=(lambda value: said.append(value) or value) if leads else lambda value: next(values))

    def trained(leads, wanted):
        seen[leads].append((wanted.all_seeds, wanted.folder, wanted.resume))
        if leads:
            shutil.copytree(bc(extended) / "blocks" / "seeds_2_2", wanted.folder)

    for leads in (True, False):
        before = sorted(tmp_path.rglob("*"))
        monkeypatch.setattr(train, "train", lambda wanted, team: trained(team.leads, wanted))
        complete(again, 3, team(leads))
    assert seen[True] == seen[False] == [(range(2, 3), blocks.place(bc(again), range(2, 3)), False)]
    assert sorted(tmp_path.rglob("*")) == before
