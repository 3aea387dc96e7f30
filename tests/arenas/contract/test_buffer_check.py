"""Room of Warp's buffers for untrained play, and the message where it is too small."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import arenas
from arenas.arena_settings import Solver
from arenas.contract import buffer_check
from arenas.contract.buffer_meter import with_meters
from arenas.contract.check import BUFFERS, check_arena
from arenas.errors import EngineError
from arenas.games.matrix.settings import ARENAS as MATRIX_GAMES
from arenas.games.matrix.turns.settings import ARENAS as TURN_GAMES
from arenas.physics.mjx import MjxEngine, overflow_causes
from arenas.physics.void_causes import Cause, causes_in, describe_causes

BODIED = sorted(set(arenas.names()) - {settings.name for settings in (*MATRIX_GAMES, *TURN_GAMES)})
ON_A_GPU = jax.default_backend() == "gpu"


def short(name: str, seconds: float, **where):
    settings: Any = arenas.settings(name)
    rules = replace(settings.rules, episode=seconds)
    return replace(settings, rules=rules).build(engine="warp", worlds=8, **where)


def full(**given) -> buffer_check.BufferUsage:
    total_size = {"episodes": 16, "void": 16, "causes": 0, "pairs": 60, "contacts": 50, "rows": 90, **given}
    return buffer_check.BufferUsage(**total_size, buffers=Solver(contacts=2, rows=64))


def test_few_worlds_have_more_slots_each_than_many():
    buffers = Solver(contacts=30, spare=20)
    assert [buffers.slots(worlds) for worlds in (1, 16, 10_000)] == [50, 560, 302_000]
    assert Solver(contacts=30).slots(4) == 180
    assert Solver(contacts=30, spare=0).slots(4) == 120


def test_what_a_user_sets_replaces_one_size_and_keeps_the_others():
    own = Solver(contacts=30, rows=90, spare=7, iterations=3)
    assert own.with_buffers(contacts=50) == replace(own, contacts=50)
    assert own.with_buffers(rows=99) == replace(own, rows=99)
    assert own.with_buffers() == own


def test_buffers_that_a_user_sets_reach_the_engine_and_leave_the_configuration_hash_alone():
    default = arenas.load("pursuit", engine="warp")
    with_buffers = arenas.load("pursuit", engine="warp", contacts=77, rows=55)
    assert isinstance(default.engine, MjxEngine)
    assert isinstance(with_buffers.engine, MjxEngine)
    assert (with_buffers.engine.buffers.contacts, with_buffers.engine.buffers.rows) == (77, 55)
    assert default.engine.buffers.contacts != 77
    assert default.config_hash == with_buffers.config_hash


@pytest.mark.parametrize(
    ("bits", "expected"),
    [
        (0, 0), (0x1, Cause.ROWS), (0x2, Cause.ROWS), (0x4, Cause.PAIRS), (0x8, Cause.CONTACTS), (0x10, Cause.CONTACTS),
        (0x20, Cause.BUFFERS), (0x100, Cause.BUFFERS), (0x5, Cause.ROWS | Cause.PAIRS),
        (0x200, 0), (0x400, 0),  # the solver used all its iterations
    ],
)  # fmt: skip
def test_each_overflow_bit_of_warp_has_its_cause(bits, expected):
    assert int(overflow_causes(jnp.int32(bits))) == expected


def test_causes_are_told_with_the_settings_that_help_against_them():
    assert list(causes_in(Cause.ROWS | Cause.PAIRS)) == [Cause.PAIRS, Cause.ROWS]
    assert describe_causes(causes_in(Cause.PAIRS | Cause.CONTACTS | Cause.ROWS)).endswith(
        "; raise buffers.contacts and buffers.rows"
    )
    assert describe_causes([Cause.NUMBERS]) == "numbers are not finite"
    assert describe_causes([]) == ""


@pytest.mark.parametrize(
    ("causes", "expected"),
    [
        (Cause.PAIRS, ["16 worlds has 40 slots", "60 pairs", "buffers.contacts"]),
        (Cause.CONTACTS, ["40 slots", "50 contacts", "buffers.contacts"]),
        (Cause.ROWS, ["64 constraint rows, and 90 were", "buffers.rows"]),
        (Cause.ROWS | Cause.PAIRS, ["60 pairs", "90 at least were"]),
        (Cause.NUMBERS, ["numbers are not finite"]),
    ],
)
def test_a_full_buffer_is_named_with_what_was_needed_and_the_setting(causes, expected):
    text = buffer_check.problem(full(causes=causes))
    assert text.startswith("16 of 16 episodes")
    assert "\n" not in text
    assert [part for part in expected if part not in text] == []


def test_one_void_episode_in_a_thousand_is_allowed_and_more_are_not():
    assert buffer_check.problem(full(episodes=2000, void=2, causes=Cause.PAIRS)) == ""
    assert "3 of 2000" in buffer_check.problem(full(episodes=2000, void=3, causes=Cause.PAIRS))


def test_only_warp_has_meters():
    with pytest.raises(EngineError, match=r"only engine warp .* sumo-1v1 runs on c"):
        with_meters(arenas.load("sumo-1v1", engine="c"), 4)


def test_the_meters_are_of_an_engine_that_pushes_the_same_bodies():
    arena = arenas.load("disturbance", engine="warp")
    assert with_meters(arena, 4).engine.pushed == arena.engine.pushed != ()


@pytest.mark.slow
def test_the_check_ends_with_the_buffer_that_is_full():
    *before, last = check_arena(short("sumo-1v1", 1.0, contacts=1))
    assert all(result.ok for result in before)
    assert last.name == BUFFERS
    assert not last.ok
    assert "slots (1 a world" in last.detail
    assert "buffers.contacts" in last.detail


@pytest.mark.slow
def test_four_anymals_that_stand_there_fit():
    """They need 40 slots a world for pairs of near geoms, and had 32."""
    found = buffer_check.measure_untrained_play(short("sumo-2v2-anymal", 1.0), worlds=4)
    assert (found.void, found.causes) == (0, 0)
    assert 4 * 30 < found.pairs < found.slots


@pytest.mark.gpu
@pytest.mark.skipif(not ON_A_GPU, reason="needs a GPU")
@pytest.mark.parametrize("name", BODIED)
def test_untrained_play_of_whole_episodes_is_not_void(name):
    assert buffer_check.problem(buffer_check.measure_untrained_play(arenas.load(name, engine="warp"))) == ""
