"""Arenas by name: those that come with the league, those in a file or module, and names that lead nowhere."""

import subprocess
import sys
from pathlib import Path

import pytest

import arenas
from arenas.contract.check import WORLDS, check_arena
from arenas.errors import ArenaError

RACE = Path(__file__).parents[1] / "race.py"


def test_what_comes_with_the_league():
    assert {"sumo-1v1", "sumo-2v2"} <= set(arenas.names())
    assert [arenas.settings(name).name for name in arenas.names()] == arenas.names()


def test_settings_are_read_without_jax_and_mujoco():
    """A configuration names an arena; to read it, or to manage a league, loads nothing heavy."""
    code = (
        "import arenas, sys; found = {n: arenas.settings(n).rules for n in arenas.names()};"
        "print(*sorted({'jax', 'mujoco', 'torch', 'numpy'} & set(sys.modules)))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == ""


def test_an_unknown_name_is_told_what_exists_and_what_is_near():
    with pytest.raises(ArenaError, match=r"^unknown arena 'sumo-2v': did you mean sumo-2v2\? \(arenas: .*sumo-1v1"):
        arenas.load("sumo-2v")
    with pytest.raises(ArenaError, match=r"^unknown arena 'chess' \(arenas: .*your own: file.py:name\)$"):
        arenas.settings("chess")


def test_an_arena_in_a_file_keeps_the_contract():
    settings = arenas.settings(f"{RACE}:race")
    broken = [p for p in check_arena(settings.build(engine="c", worlds=WORLDS), settings) if not p.ok]
    assert broken == []
    assert settings.name == f"{RACE}:race"


def test_a_file_runs_once_and_hides_no_module_of_its_name(tmp_path):
    file = tmp_path / "json.py"
    # Annotations as text, as `from __future__ import annotations` makes them, are looked up in the listed module.
    file.write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\n\n"
        "@dataclass(frozen=True)\nclass Duel:\n    name: str = 'duel'\n\nARENAS = (Duel(),)\n"
    )
    json = sys.modules["json"]
    first, second = (arenas.settings(f"{file}:duel") for _ in range(2))
    assert type(first) is type(second)
    assert sys.modules["json"] is json
    assert sys.modules[type(first).__module__].__file__ == str(file)


def test_a_file_that_fails_is_run_again(tmp_path):
    file = tmp_path / "duel.py"
    file.write_text("import nowhere_to_be_found\n")
    for _ in range(2):
        with pytest.raises(ModuleNotFoundError, match="nowhere_to_be_found"):
            arenas.settings(f"{file}:duel")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no/such.py:duel", "^no arena file no/such.py: give a path such as"),
        ("nowhere.such:duel", "^no arena module 'nowhere.such': give a file"),
        ("json:duel", r"^json lists no arenas: it needs ARENAS = "),
        (str(RACE), r"race\.py is a file: name an arena in it: .*race\.py:race$"),
        ("my/league.toml", r"^my/league\.toml is a file of settings, and an arena is asked for: give its arena\.name"),
        (f"{RACE}:rice", r"^unknown arena .*: did you mean race\? \(arenas: race; your own: file.py:name\)$"),
    ],
)
def test_a_file_or_module_without_the_arena_is_told_so(name, message):
    with pytest.raises(ArenaError, match=message):
        arenas.settings(name)


def test_arenas_that_are_no_tuple_are_told_so(tmp_path):
    (tmp_path / "alone.py").write_text("ARENAS = 3\n")
    with pytest.raises(ArenaError, match=r"alone\.py: ARENAS is a int: it needs ARENAS = \(settings, \.\.\.\)"):
        arenas.settings(f"{tmp_path}/alone.py:duel")


def test_two_arenas_of_one_name_are_told_so(tmp_path):
    (tmp_path / "twice.py").write_text("from types import SimpleNamespace as S\nARENAS = (S(name='duel'),) * 2\n")
    with pytest.raises(ArenaError, match=r"twice\.py: two of its ARENAS are named duel: give one of them another name"):
        arenas.settings(f"{tmp_path}/twice.py:duel")


def test_a_module_that_lacks_something_else_is_not_called_absent(tmp_path, monkeypatch):
    (tmp_path / "needy_arena.py").write_text("import nowhere_to_be_found\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="nowhere_to_be_found"):
        arenas.settings("needy_arena:duel")
