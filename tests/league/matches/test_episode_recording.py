"""What a recording tells of an episode; the games here are invented so that it is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from agents.rollout.rollout import PlayedEpisodes
from arenas.robots.puck import RADIUS
from arenas.state import Frames
from league.matches.episode_recording import _outcome, episode
from storage.records import Snapshot
from tests.arenas.race import RaceRules, RaceSettings
from tests.league.conftest import PUCKS

SIDES = [Snapshot("cup", name, name, "puck:6:2") for name in ("blue@1", "red@1")]


@pytest.fixture(scope="module")
def arena():
    return arenas.load(PUCKS[1], engine="c", threads=1)


def told(arena, x: np.ndarray, arrived: int | None = None, void: bool = False) -> list[tuple[int, str]]:
    """The events of an episode (T decisions) in which blue stands at 0 and red at x (T, 5) m."""
    T, hold = x.shape
    qpos = np.zeros((T, hold, 14))
    qpos[..., [3, 10]], qpos[..., [2, 9]], qpos[..., 7] = 1.0, 0.3, x
    events = np.zeros((T, hold, 1, 2), bool)
    if arrived is not None:
        events.reshape(-1, 2)[arrived:, 1] = True
    zeros = np.zeros((T, hold, 1, 2))
    time = arena.timing.control_interval * np.arange(1, T * hold + 1).reshape(T, hold, 1)
    over = time > arena.timing.episode - arena.timing.control_interval / 2
    over[-1, -1] = True
    if arrived is not None:
        over.reshape(-1)[arrived:] = True
    frames = Frames(
        qpos[:, :, None], time, {"flag": np.zeros((T, hold, 1, 3))}, {"lead": zeros}, {}, {"arrival": events}, over
    )
    score = np.array([[0.5, 0.5] if arrived is None else [0.0, 1.0]])
    games = PlayedEpisodes(
        score=score, void=np.array([void]), at_fault=np.zeros((1, 2), bool), decisions=np.array([T]), frames=frames,
        actions={"blue/0": np.zeros((T, 1, 2)), "red/0": np.zeros((T, 1, 2))}, reward=np.zeros((T, 1, 2)),
        running=np.ones((T, 1), bool),
    )  # fmt: skip
    return list(episode(arena, games, 0, SIDES, "cup", 1, 0).events)


def test_the_first_touch_of_two_teams_is_an_event(arena):
    apart = np.full((3, 5), 3.0)
    assert told(arena, apart, arrived=14) == [(14, "arrival: red"), (14, "red@1 wins as red")]
    apart[1, 2:] = 1.5 * RADIUS
    assert told(arena, apart, arrived=14)[0] == (7, "contact")


def test_time_that_is_up_is_an_event_unless_the_game_ended_in_that_step(arena):
    whole = np.full((arena.timing.decisions, 5), 3.0)
    last = whole.size - 1
    assert told(arena, whole) == [(last, "timeout"), (last, "draw")]
    assert told(arena, whole, arrived=last) == [(last, "arrival: red"), (last, "red@1 wins as red")]
    assert told(arena, whole, arrived=last - 2) == [(last - 2, "arrival: red"), (last, "red@1 wins as red")]
    assert told(arena, whole[:5]) == [(24, "draw")]


def test_two_that_touch_in_the_last_step_do_not_hide_that_time_is_up(arena):
    whole = np.full((arena.timing.decisions, 5), 3.0)
    whole[-1, -1] = 1.5 * RADIUS
    last = whole.size - 1
    assert told(arena, whole) == [(last, "contact"), (last, "timeout"), (last, "draw")]


def test_a_void_episode_has_not_timed_out(arena):
    whole = np.full((arena.timing.decisions, 5), 3.0)
    assert told(arena, whole, void=True) == [(whole.size - 1, "void")]


def test_a_step_tells_in_which_control_step_the_episode_ended():
    """A sprinter reaches the flag amid a decision; the frames after it are of a game that is over."""
    arena = RaceSettings(rules=RaceRules(reach=1.95)).build(engine="c", threads=1)
    step, state = jax.jit(arena.step_with_frames), arena.reset(jax.random.key(0))
    frames, decisions = None, 0
    while not state.done and (decisions := decisions + 1) < 20:
        to_flag = {name: 10.0 * seen[2:4] for name, seen in state.observations.items()}
        state, frames = step(state, to_flag | {"red/0": jnp.zeros(2)})
    assert frames is not None
    arrival, over = np.asarray(frames.events["arrival"])[:, 0], np.asarray(frames.over)
    assert (np.argmax(over), over.sum() > 1) == (np.argmax(arrival), True)
    assert over[np.argmax(over) :].all()


def test_a_void_episode_says_so_and_numbers_that_are_none_touch_nobody(arena):
    broken = np.full((2, 5), 3.0)
    broken[1] = np.nan
    assert told(arena, broken, void=True) == [(9, "void")]


@pytest.mark.parametrize(
    ("score", "outcome"),
    [
        ((2.0, 5.0, 1.0), "q wins as red"),
        ((5.0, 1.0, 5.0), "p as blue and r as green tie ahead of the others"),
        ((3.0, 3.0, 3.0), "draw"),
    ],
)
def test_the_outcome_of_three_teams_names_who_is_ahead(score, outcome):
    sides = [Snapshot("tiny", name, name, "puck:22:2") for name in "pqr"]
    assert _outcome(np.array(score), False, sides, ("blue", "red", "green")) == outcome
