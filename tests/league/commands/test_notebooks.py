"""The notebooks of the documents do what they say, and carry no outputs."""

import base64
import json
from pathlib import Path

import pytest

from tests.league.conftest import ROOT

NOTEBOOKS = ROOT / "docs" / "notebooks"
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:matplotlib")


def cells(name: str) -> list[str]:
    """The code of a notebook."""
    found = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text("utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def execute(name: str) -> dict:
    """Run the cells of a notebook one after the other; the names that they define."""
    names: dict = {}
    for code in cells(name):
        exec(compile(code, name, "exec"), names)
    return names


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("notebooks")


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_outputs_are_stripped(path: Path):
    for cell in json.loads(path.read_text("utf-8"))["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


@pytest.mark.slow
def test_the_notebook_of_run_and_then_that_of_open(folder, monkeypatch, capsys):
    import matplotlib

    matplotlib.use("agg")
    monkeypatch.chdir(folder)
    ran = execute("run")
    printed = capsys.readouterr().out
    assert "League scissors: blue (1 × chooser) against red" in printed
    assert "learner.lr = 3.0: must be between 0.0 and 1.0" in printed
    players = ran["opened"].players()
    assert set(players.steps) == {24_576}
    assert ran["seen"] == sorted(ran["seen"])
    assert ran["seen"][-1] >= 8
    found = execute("open")
    assert set(found["payoff"].scores.index) <= set(found["opened"].snapshots().name)
    assert found["payoff"].games.sum().sum() > 0
    assert found["policy"].snapshot.name == "blue@12"
    assert found["opponents"].attrs["kind"] == "latest"


@pytest.mark.slow  # it compiles an arena with bodies
def test_the_notebook_of_watch_shows_a_film(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("ROBOT_LEAGUE_CACHE", str(folder / "cache"))
    episode = execute("watch")["episode"]
    assert " against " in capsys.readouterr().out
    assert f"base64,{base64.b64encode(episode.film().read_bytes()).decode()}" in episode._repr_html_()
    assert episode.film().is_relative_to(folder / "cache")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["run", "open", "watch"])
def test_the_notebooks_run_in_a_kernel(name, folder):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    found = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    nbclient.NotebookClient(found, timeout=300, resources={"metadata": {"path": str(folder)}}).execute()
