"""The notebooks of the documents do what they say in a kernel, and carry no outputs."""

import json
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.league.conftest import ROOT

NOTEBOOKS = ROOT / "docs" / "notebooks"


def executed(name: str, folder: Path, then: str) -> str:
    """Run the cells of a notebook in a kernel, then those lines, which may assert; return what was printed."""
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(then))
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return "".join(output["text"] for output in outputs if output["output_type"] == "stream")


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_outputs_are_stripped(path: Path):
    for cell in json.loads(path.read_text("utf-8"))["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


RAN = """
assert set(opened.players().steps) == {24_576}
assert seen == sorted(seen)
assert seen[-1] >= 8
"""
OPENED = """
assert set(payoff.scores.index) <= set(opened.snapshots().name)
assert payoff.games.sum().sum() > 0
assert policy.snapshot.name == "blue@12"
assert opponents.attrs["kind"] == "latest"
"""
WATCHED = """
import base64, pathlib

assert f"base64,{base64.b64encode(episode.film().read_bytes()).decode()}" in episode._repr_html_()
assert episode.film().is_relative_to(pathlib.Path("cache").resolve())
"""


@pytest.mark.slow
def test_the_notebook_of_run_and_then_that_of_open(tmp_path):
    printed = executed("run", tmp_path, RAN)
    assert "League scissors: blue (1 × chooser) against red" in printed
    assert "learner.lr = 3.0: must be between 0.0 and 1.0" in printed
    executed("open", tmp_path, OPENED)


@pytest.mark.slow  # it compiles an arena with bodies
def test_the_notebook_of_watch_shows_a_film(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOT_LEAGUE_CACHE", str(tmp_path / "cache"))
    assert " against " in executed("watch", tmp_path, WATCHED)
