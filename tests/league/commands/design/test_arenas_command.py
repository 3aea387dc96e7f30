"""`league arenas`: a line for each arena without anything heavy, and all about one of them."""

import json
import subprocess
import sys

import pytest

import arenas
from league.commands import cli
from league.queries import arena_info
from tests.league.conftest import ROOT

RACE = f"{ROOT / 'tests' / 'arenas' / 'race.py'}:race"


@pytest.fixture(autouse=True)
def platform_comes_back(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # the command sets it for its own process


def printed(capsys, *args):
    with pytest.raises(SystemExit) as end:
        cli.main(["arenas", *args])
    out, err = capsys.readouterr()
    return end.value.code, out, err


def test_the_list_says_who_plays_how_often_they_decide_and_what_they_see(capsys):
    code, out, _ = printed(capsys, "--format", "json")
    rows = {row["arena"]: row for row in json.loads(out)}
    assert code == 0
    assert set(rows) == set(arenas.names())
    assert rows["sumo-by-team"]["teams"] == "blue: 2 × anymal, red: 2 × leatherback"
    assert rows["sumo-within-team"]["teams"] == "blue and red: 1 × anymal + 1 × leatherback each"
    assert rows["anymal-walk"]["teams"] == "blue: 1 × anymal"
    assert (rows["sumo-2v2"]["decisions_per_second"], rows["sumo-2v2"]["episode"]) == (10, 10)
    assert rows["sumo-by-team"]["sees"] == "56, 14"
    assert all(row["what"] for row in rows.values())


def test_the_list_loads_nothing_heavy():
    program = (
        "import sys; from league.commands.design.arenas import arenas; arenas([])\n"
        "print([name for name in ('jax', 'torch', 'mujoco', 'pandas') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "sumo-2v2" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


def test_all_about_an_arena_loads_no_torch():
    program = (
        "import sys; from league.commands.design.arenas import arenas; arenas(['matching-pennies'])\n"
        "print('torch' in sys.modules, 'jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False True"


def test_all_about_an_arena(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    code, out, _ = printed(capsys, "sumo-within-team")
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert code == 0
    assert "blue 1 × anymal + 1 × leatherback idle, random, pusher" in lines
    assert "Anymal (blue/0, red/0) sees 56 numbers" in lines
    assert "45-47 slot A m enemy 1: position in its own frame" in lines
    assert "Leatherback (blue/1, red/1) sees 14 numbers" in lines
    assert "13 radius m of the ring, at present" in lines
    assert "result reward at the end: +10 for a win, -10 for a loss" in lines
    assert "fall event a robot of the team has fallen" in lines
    assert "--arena.rules.ring 3.0,6.0 Ring radius in metres, drawn uniformly per episode" in lines
    assert "Its page: docs/arenas/sumo.md, its picture: docs/pictures/arenas/sumo-within-team.webp" in lines
    assert any(line.startswith("50 decisions per second, held for 1 control step of 0.02 s each") for line in lines)


def test_a_term_that_has_its_weight_among_the_settings_is_told_by_the_note_there():
    found = arena_info.sheet(arenas.settings("anymal-walk"))
    assert found.legend.rewards["reached"] == "+10 once, when the goal is reached"
    assert all(found.legend.rewards.values())


@pytest.mark.parametrize("name", arenas.names())
def test_nothing_is_left_without_words(name):
    found = arena_info.sheet(arenas.settings(name))
    every = [*found.legend.rewards.values(), *found.legend.shapings.values(), *found.legend.events.values()]
    assert all([found.outline.what, found.legend.score, *every])
    assert "unnamed" not in {part.name for role in found.roles for part in (*role.observation, *role.action)}


def test_an_arena_of_ones_own_needs_no_words(capsys):
    code, out, _ = printed(capsys, RACE, "--format", "json")
    found = json.loads(out)
    assert code == 0
    assert found["roles"][0]["observation"] == [
        {"index": "0-5", "name": "unnamed", "size": 6, "unit": "", "meaning": "", "opponent": False}
    ]
    assert found["roles"][0]["action"][0]["name"] == "thrust"
    assert found["scripts"]["blue"] == ["idle", "random", "sprinter"]
    assert found["settings"]["rules"] == {"reach": 0.3, "episode": 4.0}
    assert printed(capsys, RACE)[1].startswith(f"{RACE}: One puck each.")


def test_an_unknown_arena_is_one_line_and_exit_code_2(capsys):
    code, out, err = printed(capsys, "sumo-9v9")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert "unknown arena 'sumo-9v9'" in err
    assert "sumo-by-team" in err
