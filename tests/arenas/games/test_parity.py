"""Whole arenas on every engine: the same start and the same actions lead to the same places, and to the same scores.

Positions are compared before contacts have made chaos of them; scores over whole matches, which they have.
"""

from functools import lru_cache

import jax
import numpy as np
import pytest

import arenas
from arenas.games.matrix.settings import ARENAS as MATRIX_GAMES
from arenas.games.matrix.turns.settings import ARENAS as TURN_GAMES
from tests.arenas.race import RaceSettings

WORLDS = 4
HORIZON = 0.2  # s
TOLERANCE = 1e-3  # m, of any robot's base; measured on a CPU with MJX: two rovers 1.9e-6, two pucks 5e-7
MOVED = 1e-7  # m and rad, by which a start is moved to see how much of a gap comes from rounding
# Arenas whose model is another's too, or without bodies. They are not looked for here: loading all takes a second.
SAME = {"disturbance", "run-to-goal", "run-to-goal-humanoids", "soccer-ball", "soccer-walk", "sumo-humanoids"}
BODILESS = {settings.name for settings in (*MATRIX_GAMES, *TURN_GAMES)}
GAMES = sorted(set(arenas.names()) - SAME - BODILESS)  # one for each model
OTHERS = ("jax", "warp")
# Blocks, a ball, tanks and drones meet robots in these. Two rovers meet in test_decisions.py, and each robot alone is
# compared in test_bodies_on_engines.py.
IN_CI = {
    ("block-push-leatherback", "warp"), ("soccer-1v1", "warp"), ("galaga-1v1", "warp"), ("sumo-ants", "warp"),
}  # fmt: skip
TRIED = [
    pytest.param(name, engine, marks=pytest.mark.slow if (name, engine) in IN_CI else pytest.mark.gpu)
    for name in GAMES
    for engine in OTHERS
]
STAY = {"galaga-aim-1v1", "galaga-aim-2v2"}  # where a tank is alone: what moves is its barrel


def script_of(arena, team):
    return next(
        name for name in ("pusher", "striker", "trot", "sprinter", "random") if name in arena.playable_scripts(team)
    )


def travel(arena, actions=None):
    """Bases (T, WORLDS, robots, 3) m over the horizon, and the actions that led there: those given, or scripts'."""
    scripts = arena.scripts()
    acting = {a.name: scripts[script_of(arena, team)][a.kind] for team in arena.teams for a in team.agents}
    decisions = round(HORIZON / (arena.timing.control_interval * arena.timing.hold))
    at = np.array([index.qpos for index in arena.scene.agents.values()])[:, None] + np.arange(3)

    def decision(state, of):
        key, told = of
        chosen = told or {name: jax.vmap(act)(state.observations[name], key) for name, act in acting.items()}
        state = jax.vmap(arena.step)(state, chosen)
        return state, (*jax.lax.optimization_barrier((state.physics.qpos[:, at], state.void)), chosen)

    @jax.jit
    def run(key, actions):
        start = jax.vmap(arena.reset)(jax.random.split(key, WORLDS))
        keys = jax.random.split(key, (decisions, WORLDS))
        return jax.lax.scan(decision, start, (keys, actions))[1]

    upright_poses, void, actions = jax.device_get(run(jax.random.key(0), actions))
    assert not void.any()
    return upright_poses, actions


@lru_cache(maxsize=1)
def native(settings):
    """What `travel` gives on the C engine."""
    return travel(settings.build(engine="c", worlds=WORLDS))


def sensitivity(settings):
    """The largest gap, m, between robots of the C engine that start a rounding error apart."""
    there, actions = native(settings)
    arena = settings.build(engine="c", worlds=WORLDS)
    place = arena.place

    def moved(key):
        qpos, qvel, game = place(key)
        return qpos + MOVED * jax.random.normal(jax.random.fold_in(key, 1), qpos.shape), qvel, game

    arena.place = moved
    return np.linalg.norm(travel(arena, actions)[0] - there, axis=-1).max()


def gap(settings, engine):
    """The largest gap of any base, m, and how far the farthest of them went on the C engine."""
    there, actions = native(settings)
    here, _ = travel(settings.build(engine=engine, worlds=WORLDS), actions)
    return np.linalg.norm(here - there, axis=-1).max(), np.linalg.norm(there - there[0], axis=-1).max()


@pytest.mark.slow
def test_each_model_is_driven_once():
    models = {name: arenas.load(name, engine="c").scene.xml for name in GAMES}
    assert len(set(models.values())) == len(GAMES)
    assert {arenas.load(name, engine="c").scene.xml for name in SAME} <= set(models.values())


@pytest.mark.slow  # the small scene that every `make test` drives through MJX is that of test_engines.py
@pytest.mark.parametrize("engine", OTHERS)
def test_pucks_go_the_same_way(engine):
    apart, far = gap(RaceSettings(), engine)
    assert apart < 1e-5
    assert far > 0.01


@pytest.mark.parametrize(("name", "engine"), TRIED)
def test_robots_go_the_same_way(name, engine):
    settings = arenas.settings(name)
    apart, far = gap(settings, engine)
    # A rover beside an ANYmal is 2 mm away from itself if its start is 3e-8 m off: no engine can be nearer than that.
    assert apart < TOLERANCE or apart < 2 * sensitivity(settings)
    assert far > 0.003 or name in STAY


def results(engine, blue, red, matches=500):
    """Wins, draws and losses of blue over whole matches of two rovers."""
    arena = arenas.load("sumo-1v1", engine=engine, worlds=matches)
    scripts, names = arena.scripts(), [agent.name for agent in arena.agents]
    acting = dict(zip(names, (scripts[blue]["leatherback"], scripts[red]["leatherback"]), strict=True))

    def decision(state, key):
        keys = jax.random.split(key, matches)
        return jax.vmap(arena.step)(
            state, {name: jax.vmap(act)(state.observations[name], keys) for name, act in acting.items()}
        ), None

    @jax.jit
    def run(key):
        start = jax.vmap(arena.reset)(jax.random.split(key, matches))
        return jax.lax.scan(decision, start, jax.random.split(key, arena.timing.decisions))[0]

    state = jax.device_get(run(jax.random.key(0))._replace(physics=()))
    assert state.void.mean() < 0.01
    score = state.verdict.score[~state.void, 0]
    return np.array([(score == points).sum() for points in (1.0, 0.5, 0.0)])


@pytest.mark.parametrize(
    ("sides", "engine"),
    [
        pytest.param(("centre-holder", "pusher"), "jax", marks=pytest.mark.gpu),
        pytest.param(("pusher", "pusher"), "jax", marks=pytest.mark.gpu),
        pytest.param(("centre-holder", "pusher"), "warp", marks=pytest.mark.gpu),
        pytest.param(("pusher", "pusher"), "warp", marks=pytest.mark.gpu),
    ],
)
def test_whole_matches_end_alike(sides, engine):
    """500 matches from the same starts: shares of wins, draws and losses within 3 standard errors of their gap."""
    ours, theirs = results(engine, *sides), results("c", *sides)
    one, other = ours / ours.sum(), theirs / theirs.sum()
    error = np.sqrt((one * (1 - one) / ours.sum()) + other * (1 - other) / theirs.sum())
    assert (np.abs(one - other) <= 3 * error + 1 / theirs.sum()).all(), (ours, theirs)
    assert (theirs > 0).sum() > 1  # or there is nothing to tell apart
