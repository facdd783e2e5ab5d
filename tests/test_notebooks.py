"""Notebooks run from top to bottom, whatever runs lie about, and are committed without what they print."""

import json
import re
import shutil
from pathlib import Path

import nbformat
import pytest
from matplotlib.figure import Figure
from nbclient import NotebookClient

from rtc_mjx import cache, figures

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
WITHOUT_RESULTS = "conditional_type_shift"  # the others draw those that are committed


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_notebooks_are_committed_without_outputs(file):
    assert not any(cell.outputs or cell.execution_count for cell in code(nbformat.read(file, as_version=4)))


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_notebooks_run_and_show_their_figures(file, tmp_path, monkeypatch):
    """In a folder of their own: `../runs` is not there, so that they train what they show."""
    for name in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(cache.keep_compiled()))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    place = tmp_path / "notebooks"
    place.mkdir()
    if file.stem != WITHOUT_RESULTS:
        shutil.copytree(ROOT / "results", tmp_path / "results")
    notebook = nbformat.read(file, as_version=4)
    NotebookClient(notebook, timeout=1500, kernel_name="python3", resources={"metadata": {"path": str(place)}}).execute()
    outputs = [output for cell in code(notebook) for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output.get("name") == "stderr" for output in outputs)


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_notebooks_leave_it_to_the_tables_to_name_the_commands(file):
    """A command of their own would make, in the same folders, runs and results that are not those that they show."""
    text = "".join(cell.source for cell in nbformat.read(file, as_version=4).cells if cell.cell_type == "markdown")
    tables = [file.parent / place for place in re.findall(r"\]\((\.\./results/\w+/table\.md)\)", text)]
    assert "rtc_mjx.study" not in text and tables and all("Made by `python -m rtc_mjx.study" in table.read_text() for table in tables)


def test_figures_say_where_there_are_no_results_yet(tmp_path):
    axes = Figure().subplots()
    figures.by_source(axes, figures.results(tmp_path, ("bc", "rtc_c")), "return")
    assert [text.get_text() for text in axes.texts] == ["no results yet"]


def test_what_type_shift_said_is_found_among_results(tmp_path):
    (tmp_path / "bc.json").write_text(json.dumps({"metrics": {}}))
    (tmp_path / "rtc_c.json").write_text(json.dumps({"type_shift": {"metric": "return"}}))
    assert figures.shifts(tmp_path, ("bc", "mgail", "rtc_c")) == {"rtc_c": {"metric": "return"}}
