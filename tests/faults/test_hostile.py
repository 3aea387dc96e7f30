"""A few cases of bad input of every class: one line, exit code 2, nothing changed. `fuzz.py` tries thousands."""

import ast
import contextlib
import pickle
import sqlite3
from pathlib import Path

import pytest

from storage.store import Store
from tests.faults.fuzz import CLASSES, answer, corpus, tally, tried
from tests.faults.hostile import Case
from tests.league.conftest import ROOT

CASES = 20
FOLDERS = ("league", "arenas", "agents", "matchmaking", "storage", "dashboards")


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    corpus(folder)
    return folder


@pytest.mark.parametrize("name", CLASSES)
def test_bad_input_is_answered_in_one_line_and_changes_nothing(name: str, kept: Path, tmp_path: Path):
    found = tally(name, CASES, kept, tmp_path / "case", random=0)
    assert found.examples == {}
    assert (found.refused > 0) == (name != "foreign names")  # a name that a terminal would obey is a name
    assert found.cases >= CASES // 2  # Hypothesis leaves out what it has tried


@pytest.mark.parametrize("path", [p for f in FOLDERS for p in (ROOT / f).rglob("*.py")], ids=lambda p: p.name)
def test_nothing_is_read_or_kept_as_pickle(path: Path):
    """Between processes of its own Python does so; what lies in files and databases is data and never code."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [each.name for each in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        assert not {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"} & set(names)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            call = ast.unparse(node.func)
            assert call not in ("torch.load", "torch.save", "np.load", "np.save", "pd.read_pickle", "numpy.load")
            assert not call.endswith(".to_pickle")


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, file: Path):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


def test_a_pickle_in_place_of_any_file_is_refused_and_not_run(kept: Path, tmp_path: Path):
    fired = tmp_path / "fired"
    bomb = pickle.dumps(Bomb(fired))
    folder = tmp_path / "case"
    with Store.open(folder / "store", create=True) as store:
        from tests.storage.sound import fill

        fill(store)
    for blob in (folder / "store" / "blobs").glob("*/*"):
        blob.write_bytes(bomb)
    for name in ("cup.zip", "x.safetensors", "league.toml", "x.csv", "other.db"):
        (folder / name).write_bytes(bomb)
    for args in (
        ("verify", "--store", "store"), ("export", "blue@1", "-o", "new", "--store", "store"), ("rate", "x.csv"),
        ("unpack", "cup.zip", "--store", "new"), ("import", "x.safetensors", "--as", "x", "--store", "store"),
        ("run", "league.toml"), ("status", "--store", "sqlite:///other.db"), ("meta", "x.csv"),
    ):  # fmt: skip
        code, _, said = answer(args, folder)
        assert code == (1 if args[0] == "verify" else 2), (args, said)
        assert not fired.exists(), args
    pickle.loads(bomb)
    assert fired.exists()  # it would have


FOUND = {
    "curves of a league that has not learnt": (("curves", "--store", "store"), "DELETE FROM curves", 0),
    "matches of a league without players": (("payoff", "--store", "store"), "DELETE FROM players", 2),
    "a name that is no text": (("forgetting", "--store", "store"), "UPDATE OR IGNORE snapshots SET name = x'91ff'", 2),
    "nobody who leads for ever": (("status", "--store", "store"), "UPDATE leagues SET lead_until = ''", 0),
    "a leader without a process": (
        ("status", "--store", "store"),
        "UPDATE leagues SET leader = 'x', lead_until = 1e18",
        0,
    ),
    "fewer voids than none": (("forgetting", "--store", "store"), "UPDATE matches SET voids = -7", 2),
    "a time that is none": (("payoff", "--store", "store"), "UPDATE matches SET created = 'soon'", 2),
    "a password behind no name": (("status", "--store", "//:hunter2@-1"), "", 2),
    "a password behind four slashes": (("status", "--store", "sqlite:////bob:hunter2@h/x.db"), "", 2),
    "a password behind a folder": (("verify", "--store", "sqlite:///runs/bob:hunter2@bob:hunter2@"), "", 2),
    "brackets that are no address": (("thin", "--blobs", "http://-1387810[[[[&-5m"), "", 2),
    "a number of more digits than Python reads": (("run", "big.toml", "--help"), "", 2),
    "an archive that begins too late": (("unpack", "late.zip", "--store", "new"), "", 2),
}
"""Bad answers that the campaign of `fuzz.py` found, and that are mended."""


@pytest.mark.parametrize("what", FOUND)
def test_what_was_found_once_stays_answered(what: str, kept: Path, tmp_path: Path):
    args, statement, expected = FOUND[what]

    def harm(folder: Path) -> None:
        (folder / "big.toml").write_text(f"seed = {'7' * 10_000}")
        (folder / "late.zip").write_bytes((folder / "cup.zip").read_bytes()[40:])
        with contextlib.closing(sqlite3.connect(folder / "store" / "league.db")) as rows, rows:
            rows.executescript(statement)

    code, bad, said = tried(Case(args, harm), kept, tmp_path / "case")
    assert (code, bad) == (expected, ""), said
