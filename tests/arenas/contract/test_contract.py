"""Every arena keeps the contract on every engine, and the examination catches those that do not."""

import itertools
import re
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.arena_settings import Timing
from arenas.contract.check import FOUND, RUNS, SHAPES, check_arena, examine
from arenas.contract.check_run import WORLDS, CheckRun
from arenas.contract.checks import CHECKS
from arenas.contract.shape_checks import check_shapes
from arenas.errors import ArenaError, EngineError
from arenas.robots.puck import PUCK
from tests.arenas import faulty
from tests.arenas.race import Race, RaceRules, RaceSettings
from tests.arenas.solo import SoloSettings

RACE = RaceSettings(rules=RaceRules(episode=1.0))


def broken(settings, engine):
    arena = settings.build(engine=engine, worlds=WORLDS)
    assert arena.engine.name in (engine, "none")
    return [check for check in check_arena(arena, settings) if not check.ok]


QUICK = {"sumo-1v1", "pursuit", "tag", "rock-paper-scissors", "kuhn-poker"}
# One of each game with bodies, over whole episodes too.
WHOLE = {"sumo-1v1", "soccer-1v1", "galaga-aim-1v1", "pursuit", "tag", "run-to-goal"}
# Same class and robots as another arena that is examined here, with other numbers or fewer robots.
ALIKE = {
    "block-push-anymal", "galaga-1v1", "galaga-aim-2v2", "galaga-fly-1v1", "gate-race", "run-to-goal-humanoids",
    "soccer-2v2", "soccer-score", "sumo-1v1-anymal", "sumo-1v1-leatherback", "sumo-2v2-anymal", "sumo-2v2-leatherback",
    "sumo-humanoids",
}  # fmt: skip


def when(name):
    """The mark of an examination with short matches: some are quick, and whole matches include short ones."""
    if name in QUICK:
        return []
    return pytest.mark.gpu if name in ALIKE | WHOLE else pytest.mark.slow


@pytest.mark.parametrize("name", [pytest.param(n, marks=when(n)) for n in arenas.names()])
def test_arenas_keep_the_contract(name):
    """With matches of two seconds at most, for an episode of random play takes longest; whole ones are slow."""
    settings = arenas.settings(name)
    if hasattr(settings.rules, "episode"):
        settings = replace(settings, rules=replace(settings.rules, episode=min(2.0, settings.rules.episode)))
    assert broken(settings, "c") == []


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n in WHOLE else pytest.mark.gpu) for n in arenas.names()],
)
def test_arenas_keep_the_contract_over_whole_episodes(name):
    assert broken(arenas.settings(name), "c") == []


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(ALIKE))
def test_hooks_of_arenas_that_are_like_others_give_what_they_declare(name):
    assert check_shapes(CheckRun(arenas.load(name, engine="c", worlds=WORLDS), jax.random.key(0))) == ""


def test_an_arena_that_is_not_examined_here_is_like_one_that_is():
    examined = {type(arenas.settings(name)) for name in set(arenas.names()) - ALIKE}
    assert {type(arenas.settings(name)) for name in ALIKE} <= examined


def test_an_arena_of_one_team_keeps_the_contract():
    assert broken(SoloSettings(), "c") == []


@pytest.mark.parametrize("engine", ["jax", "warp"])
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(arenas.settings("sumo-1v1"), marks=pytest.mark.gpu),
        pytest.param(RaceSettings(), marks=pytest.mark.slow),
        pytest.param(SoloSettings(), marks=pytest.mark.gpu),
    ],
)
def test_arenas_keep_the_contract_on_accelerators(settings, engine):
    assert broken(settings, engine) == []


# arena and what is said of its hooks
MISSHAPEN = [
    (faulty.Ghostly, r"observations are of \['blue/0', 'green/0', 'red/0'\], agents are"),
    (faulty.Unsized, r"the observation of blue/0 is float32 \(6,\), not float32 \(7,\)"),
    (faulty.Whole, r"the observation of blue/0 is int32 \(6,\), not float32 \(6,\)"),
    (faulty.Stingy, r"reward lead is float32 \(1,\), not float32 \(2,\)"),
    (faulty.Nameless, "event 'a/b' needs a name"),
    (faulty.Unpainted, "kinds: circle"),
    (faulty.Halved, r"alive gives bool \(1,\), not bool \(2,\)"),
]

# arena, how the check that it breaks begins, what is said of it
BROKEN = [
    (faulty.Renamed, "agents are named", r"agents \['red/0', 'blue/0'\]"),
    (faulty.Blind, "observations are finite", "blue/0 observes numbers that are not finite, at index 4"),
    (faulty.Partial, "exchangeable teams", "the observation of (red|blue)/0 differs, by up to 0.0"),
    (faulty.Weighty, "reset and step give", "lax.scan"),
    (faulty.Haunted, "an agent that is out", r"actions\['red/0'\] differs, by NaN"),
    (faulty.Infinite, "rewards, shapings", "approach is not finite"),
    (faulty.Endless, "an episode ends", "8 of 8 worlds go on after 10 decisions"),
    (faulty.TwiceEnded, "an end is", "two of them"),
    (faulty.Undecided, "a verdict is", "changes after the end"),
    (faulty.Generous, "scores lie", r"\[\[1.0, 1.0\]\]"),
    (faulty.Haphazard, "the key decides", "game differs, by up to"),
    (faulty.Gossiping, "worlds do not", "observations"),
    (faulty.Nostalgic, "a restarted world", "verdict"),
    (faulty.Sweeping, "a restart leaves", "physics.qpos differs, by up to"),
    (faulty.Forgetful, "a saved world", "physics.time differs, by up to 0.1"),
    (faulty.Unshakeable, "unstable physics", r"make these void: \[\]"),
    (faulty.Trusting, "non-finite actions", r"teams at fault are \[\], not \[\[0, 0\], \[1, 1\]\]"),
    (faulty.Unsorted, "entities are sets", "entities name the place 6, and the observation has 6 numbers"),
    (faulty.Miscounted, "a first decision", "blue/0 sets 1 things, with 2 numbers of an action"),
    (faulty.Misspoken, "scripts return", r"shout gives blue/0 \(6,\) numbers, not 2 finite ones"),
    (faulty.Embellished, "frames are one", "approach differs, by up to 5"),
    (faulty.Zeroed, "recorded frames", "qpos differs, by up to"),
]


@pytest.mark.parametrize(("arena", "detail"), MISSHAPEN)
def test_hooks_that_give_something_else_are_noticed_as_they_give_it(arena, detail):
    assert re.search(detail, check_shapes(CheckRun(arena(RACE, engine="c"), jax.random.key(0))))


@pytest.mark.parametrize(("arena", "check", "detail"), BROKEN)
def test_a_broken_promise_is_noticed(arena, check, detail):
    (problem,) = (problem for name, problem in CHECKS.items() if name.startswith(check))
    run = CheckRun(arena(RACE, engine="c"), jax.random.key(0))
    assert not check_shapes(run)
    assert re.search(detail, problem(run))


def test_who_is_out_of_the_game_glides_on_and_sees_nothing():
    arena = faulty.Doomed(RACE, engine="c")
    assert [p for p in check_arena(arena, RACE) if not p.ok and "configuration" not in p.name] == []
    step, state = jax.jit(jax.vmap(arena.step)), jax.vmap(arena.reset)(jax.random.split(jax.random.key(1), 2))
    push = {name: jnp.ones((2, 2)) for name in ("blue/0", "red/0")}
    alive, speed, seen = [], [], []
    for _ in range(7):
        state = step(state, push)
        alive.append(state.alive[0].tolist())
        speed.append(float(state.physics.qvel[0, 6]))
        seen.append(bool(state.observations["red/0"].any()))
    assert alive == [[True, True]] * 4 + [[True, False]] * 3
    assert seen == [True] * 4 + [False] * 3
    assert speed[3] > speed[2] > 0
    # 0.06 s of the fifth decision with thrust, then drag alone: 2 kg/s on 1 kg.
    np.testing.assert_allclose(speed[6] / speed[5], np.exp(-0.2), rtol=0.01)
    assert not state.actions["red/0"].any()
    assert state.actions["blue/0"].all()


def test_a_game_cannot_replace_what_is_the_contracts_own():
    with pytest.raises(ArenaError, match=r"Careful\._begin: the contract of arenas uses this name: choose another"):
        type("Careful", (Race,), {"_begin": lambda self: None})


def test_every_promise_has_been_seen_broken():
    assert [next(name for name in CHECKS if name.startswith(start)) for _, start, _ in BROKEN] == list(CHECKS)


@dataclass(frozen=True)
class Careless(RaceSettings):
    def build(self, **where):
        return Race(replace(self, rules=RaceRules(episode=1.0)), **where)


def test_rules_that_do_not_count_are_noticed():
    settings = Careless(rules=RACE.rules)
    *others, last = check_arena(settings.build(engine="c"), settings)
    assert [p for p in others if not p.ok] == []
    assert last[:2] == ("the configuration hash follows the rules", False)
    assert "rules.reach = " in last.detail


class Stumbling(Race):
    def place(self, key):
        raise IndexError("no such flag\nand more")


def test_an_arena_that_does_not_run_breaks_one_promise_told_with_the_line_of_its_file():
    (only,) = check_arena(Stumbling(RACE, engine="c"))
    line = next(i for i, text in enumerate(Path(__file__).read_text().splitlines(), 1) if "no such flag" in text)
    assert only == (SHAPES, False, f"IndexError: no such flag (test_contract.py:{line})")


class Late(Race):
    def __init__(self, settings, **where):
        super().__init__(settings, **where)
        self.calls = itertools.count()

    def place(self, key):
        if next(self.calls) > 1:  # the hooks are asked what a game is like, and what it tells a critic
            raise SystemExit(3)
        return super().place(key)


def test_an_arena_that_exits_is_a_failed_check():
    *_, last = check_arena(Late(RACE, engine="c"))
    assert last[:2] == (RUNS, False)
    assert re.fullmatch(r"it exits with 3 \(test_contract.py:\d+\)", last.detail)


# a stranger's file, and what is said of it
FILES = [
    ("raise OSError('no disk')", r"OSError: no disk \(duel.py:1\)$"),
    ("import sys\nsys.exit('bye')", r"it exits with bye \(duel.py:2\)$"),
    ("def (:", r"SyntaxError: invalid syntax \(duel.py:1\)$"),
    (
        "{head}\nclass Duel(Arena):\n    pass\n{tail}",
        r"TypeError: Can't instantiate abstract class Duel.*\(duel.py:\d+\)$",
    ),
    (
        "{head}\nclass Duel:\n    def __init__(self, *a, **k):\n        1 / 0\n{tail}",
        r"ZeroDivisionError: division by zero \(duel.py:7\)$",
    ),
]
HEAD = """from dataclasses import dataclass
from arenas.arena import Arena
from arenas.arena_settings import Timing
"""
TAIL = """
@dataclass(frozen=True)
class Settings:
    name: str = "duel"
    def build(self, **where):
        return Duel("duel", {}, Timing(), {}, **where)

ARENAS = (Settings(),)
"""


@pytest.mark.parametrize(("text", "detail"), FILES)
def test_a_file_that_raises_exits_or_is_abstract_is_a_failed_check(text, detail, tmp_path):
    file = tmp_path / "duel.py"
    file.write_text(text.replace("{head}", HEAD).replace("{tail}", TAIL))
    (only,) = examine(f"{file}:duel", engine="c")
    assert only[:2] == (FOUND, False)
    assert re.match(detail, only.detail)


def test_names_that_lead_nowhere_are_no_failed_checks():
    with pytest.raises(ArenaError, match="unknown arena 'sumo-9v9'"):
        examine("sumo-9v9")
    with pytest.raises(EngineError, match="unknown engine 'physx'"):
        examine("sumo-1v1", engine="physx")


@pytest.mark.parametrize(
    ("teams", "message"),
    [
        ({"bl/ue": (PUCK,), "red": (PUCK,)}, "^team name 'bl/ue': use a letter"),
        ({"": (PUCK,)}, "^team name '': use a letter"),
        ({"blue": ()}, "^team blue has no robots"),
        ({}, "^an arena needs at least one team"),
        ({"blue": (PUCK,), "red": (replace(PUCK, action_size=3),)}, r"^robots of kind puck have \[2, 3\] actions"),
    ],
)
def test_rosters_that_cannot_be_are_refused(teams, message):
    class Any(Race):
        def __init__(self):
            super(Race, self).__init__("any", teams, Timing(), {}, engine="c")

    with pytest.raises(ArenaError, match=message):
        Any()


def test_physics_that_fails_after_the_end_is_no_fault_of_the_observation():
    run = CheckRun(faulty.Shattered(RACE, engine="c", worlds=WORLDS), jax.random.key(0))
    episode = run.episode
    assert not episode.states.void.any()
    assert episode.unstable[-1].all()
    assert not np.isfinite(episode.raw["blue/0"][-1]).all()
    assert CHECKS["observations are finite"](run) == ""
