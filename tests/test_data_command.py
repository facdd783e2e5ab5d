"""python -m rtc_mjx.data: what it says, writes and refuses."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from rtc_mjx import cli, data
from rtc_mjx.errors import RunError
from rtc_mjx.logs import read, store
from rtc_mjx.logs.convert import Options
from tests import recorded

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """One recording of each kind."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "in").mkdir()
    for kind in read.KINDS:
        (tmp_path / "in" / kind).write_bytes(recorded.written(kind))
    return tmp_path / "in"


def test_each_file_is_told_with_its_counts(folder, capsys):
    data.main([str(folder)])
    told = capsys.readouterr().out
    for kind in read.KINDS:
        assert f"{kind}: 1 recording, 2 scenes to drive" in told
    assert told.count("3 agents: 2 vehicles, 1 pedestrians") == 4 and "4 lanes (connectivity logged)" in told and "91 signal states" in told
    assert "1 bike lanes, not for driving" in told


def test_a_bad_file_among_good_ones_is_one_line_and_the_rest_goes_on(folder, capsys):
    (folder / "damaged").write_bytes(recorded.written("womd_scenario")[:-9])
    (folder / "LICENSE").write_text("terms of use\n")
    with pytest.raises(RunError, match="1 of 6 files could not be read"):
        data.main([str(folder)])
    said = capsys.readouterr()
    assert [line for line in said.err.splitlines() if line] == [f"{folder}/damaged, record 0: " + said.err.split(": ", 1)[1].strip()]
    assert said.out.count("scenes to drive") == 4 and "LICENSE\n  left out: text" in said.out


def test_converting_keeps_the_scenes(folder, monkeypatch, capsys):
    data.main([str(folder / "womd_scenario"), "--convert", "--lanes", "8"])
    assert store.whole(store.entry(folder / "womd_scenario", Options(lanes=8)))
    (folder / "old").write_text(json.dumps(recorded.gpudrive(old=True)))
    with pytest.raises(RunError, match="no scene could be made"):
        data.main([str(folder / "old"), "--convert", "--control", "sdc"])
    assert "does not say which car drove itself" in capsys.readouterr().out


def test_pictures_are_drawn_one_a_recording(folder, tmp_path):
    shard = folder / "shard"
    shard.write_bytes(recorded.tfrecord(*[recorded.scenario("../odd name").SerializeToString()] * 2))
    data.main([str(shard), "--render", str(tmp_path / "out" / "deep")])
    pictures = sorted((tmp_path / "out" / "deep").iterdir())
    assert [p.name for p in pictures] == ["_odd_name-2.png", "_odd_name.png"]
    assert all(p.read_bytes().startswith(b"\x89PNG") and p.stat().st_size > 10_000 for p in pictures)


def test_replay_tells_how_far_the_car_is_off_each_log(folder, capsys):
    data.main([str(folder / "scenarionet"), "--replay"])
    told = capsys.readouterr().out
    rows = [line for line in told.splitlines() if "/" in line and "│" in line]
    assert len(rows) == 2  # a row a scene
    assert all(0 <= float(cell) < 0.5 for row in rows for cell in row.split("│")[2:6])
    assert "median agent" in told and "95th percentile agent" in told
    pooled = [line for line in told.split("all positions of moving agents")[1].splitlines() if "│" in line]
    assert len(pooled) == 2 and all(0 <= float(cell) < 0.5 for row in pooled for cell in row.split("│")[3:5])


@pytest.mark.parametrize(
    ("options", "status", "why"),
    [
        (["nowhere"], 2, "nowhere: there is no such file"), (["in/*.tfrecord"], 2, "no file matches"), (["in/text"], 2, "this is text"),
        (["in/text", "in/text2"], 2, "none of 2 files"), (["in/gpudrive_json", "--lanes", "0"], 2, "lanes 0: at least 1"), ([], 2, "PATH"),
        (["in/gpudrive_json", "--start", "-1"], 2, "start -1"), (["in/gpudrive_json", "in/text"], 1, "1 of 2 files could not be read"),
        (["in/gpudrive_json", "--render", "in/text/x"], 2, "--render in/text/x: the folder cannot be made"),
        (["in/gpudrive_json", "--control", "me"], 2, "invalid choice: 'me'"), (["in/gpudrive_json"], 0, ""),
    ],
)  # fmt: skip
def test_exit_status_and_its_reason(folder, options, status, why, monkeypatch, capsys):
    (folder / "text").write_text("hello")
    (folder / "text2").write_text("hello")
    monkeypatch.chdir(folder.parent)
    monkeypatch.setattr(sys, "argv", ["data", *options])
    left = 0
    try:
        cli.run(data.main)
    except SystemExit as leaving:
        left = leaving.code
    said = capsys.readouterr().err
    assert left == status and why in said
    assert len(said.splitlines()) <= (3 if "in/text2" in options else 2 if status == 1 else 1)


def test_the_command_runs_and_says_nothing_on_standard_error(folder):
    command = [sys.executable, "-m", "rtc_mjx.data", str(folder / "scenarionet")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stderr == "" and "scenarionet: 1 recording, 2 scenes" in done.stdout


def test_help_explains_every_option(capsys):
    with pytest.raises(SystemExit) as leaving:
        data.main(["--help"])
    told = capsys.readouterr().out
    assert leaving.value.code == 0
    assert all(option in told for option in ("--convert", "--render DIR", "--control", "--start S", "--lanes N", "Examples:"))
