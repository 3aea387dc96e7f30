"""Gate race: what passes a gate, what ends flights and races, what that earns, and the ranking. By hand on the C
engine.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.typing import ArrayLike

from arenas.contract.check import check_arena
from arenas.contract.check_run import WORLDS, CheckRun
from arenas.contract.exchange_check import exchangeable, problem
from arenas.games.race.crossings import place_gates, wall_gaps
from arenas.games.race.match import GameState, Race
from arenas.games.race.observation import read
from arenas.games.race.settings import RaceReward, RaceRules, RaceSettings
from arenas.games.race.tracks import TRACKS, Gate, Wall
from arenas.physics.engine import Physics
from arenas.state import mean_pairwise_score
from tests.arenas.hooks import judging, observing

STEP = 0.02  # s, a control step
FLOATS = np.array([[-4.0, 7.0, 1.5], [4.0, -7.0, 1.5], [-4.0, -7.0, 1.5], [4.0, 7.0, 1.5]])  # m, far from all gates


@pytest.fixture(scope="module")
def duel() -> Race:
    return RaceSettings(reward=RaceReward(progress=1.0)).build(engine="c", threads=1)


@pytest.fixture(scope="module")
def four() -> Race:
    return RaceSettings(teams=4).build(engine="c", threads=1)


def at(arena, places=None, time=2.0, rates=None):
    """Drones level and at rest at (drones, 3) m, the others far off."""
    qpos, qvel = np.array(arena.scene.rest), np.zeros(arena.scene.model.nv)
    for i, agent in enumerate(arena.scene.agents.values()):
        qpos[agent.qpos : agent.qpos + 3] = (places or {}).get(i, FLOATS[i])
        qvel[agent.qvel + 3 : agent.qvel + 6] = (rates or {}).get(i, (0.0, 0.0, 0.0))
    numbers = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros(arena.scene.model.nu), time))
    return Physics(*numbers, causes=jnp.zeros((), jnp.uint8), carry=())


def state(
    arena: Race, gate: int = 4, passed: ArrayLike = 0, moments: ArrayLike = 0.0, contacts: ArrayLike = 0,
    flying: ArrayLike = True,
) -> GameState:  # fmt: skip
    """The same for each drone, or (drones,)."""

    def each(value, dtype):
        return jnp.asarray(np.broadcast_to(np.asarray(value, dtype), (arena.number,)))

    return GameState(
        jnp.int32(gate), each(passed, jnp.int32), each(moments, jnp.float32), each(contacts, jnp.int32),
        each(flying, bool),
    )  # fmt: skip


def judged(arena, game, before, after, time=2.0, rates=None):
    return judging(arena)(at(arena, before, time - STEP), at(arena, after, time, rates), game)


# Gates. That of number 4 stands at (1, -1, 2), half a metre to all sides, and is passed towards +x. -------------------


@pytest.mark.parametrize(
    ("was", "now", "event"),
    [
        ((0.95, -1.0, 2.0), (1.05, -1.0, 2.0), "gate"),
        ((0.9, -1.45, 2.45), (1.1, -1.45, 2.45), "gate"),
        ((0.9, -1.55, 2.0), (1.1, -1.55, 2.0), "miss"),
        ((0.9, -1.0, 1.4), (1.1, -1.0, 1.4), "miss"),
        ((0.9, -1.4, 2.0), (1.0, -1.6, 2.0), "miss"),  # on the plane 0.6 m aside
        ((0.9, -1.4, 2.0), (1.1, -1.58, 2.0), "gate"),  # half-way 0.49 m aside
        ((1.05, -1.0, 2.0), (0.95, -1.0, 2.0), None),  # the wrong way
        ((0.8, -1.0, 2.0), (0.9, -1.0, 2.0), None),  # not yet
    ],
)
def test_a_gate_is_passed_where_the_way_of_a_step_crosses_its_square_ahead(duel, was, now, event):
    game, verdict = judged(duel, state(duel), {0: was}, {0: now})
    assert [name for name in ("gate", "miss") if verdict.events[name][0]] == ([event] if event else [])
    assert game.passed.tolist() == [int(event == "gate"), 0]
    assert game.flying.tolist() == [event != "miss", True]
    assert not any(verdict.events[name][1] for name in verdict.events)


def test_the_moment_of_passing_is_that_of_the_plane_and_the_next_gate_follows_round_the_track(duel):
    game, _ = judged(duel, state(duel), {0: (0.975, -1.0, 2.0)}, {0: (1.075, -1.0, 2.0)})
    np.testing.assert_allclose(game.at, [1.98 + 0.25 * STEP, 0.0], rtol=1e-6)
    np.testing.assert_allclose(duel._next(game, 0).centre, [[1.0, -3.5, 0.75], [1.0, -1.0, 2.0]])
    np.testing.assert_allclose(duel._next(game, 1).centre, [[1.5, 3.5, 0.75], [1.0, -3.5, 0.75]])  # 4, 5, 0


def test_a_gate_has_its_corners_left_and_above_as_seen_by_who_passes_it():
    gates = place_gates((Gate(1.0, 2.0, 3.0, 90.0),))
    np.testing.assert_allclose(gates.ahead, [[0.0, 1.0, 0.0]], atol=1e-6)
    wanted = [[0.5, 2.0, 3.5], [1.5, 2.0, 3.5], [1.5, 2.0, 2.5], [0.5, 2.0, 2.5]]
    np.testing.assert_allclose(gates.corners[0], wanted, atol=1e-6)


def test_gates_are_drawn_where_they_are_judged_and_touched_by_nothing(duel):
    model = duel.scene.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for i, centre in enumerate(duel.gates.centre):
        beams = {name: model.geom(f"gate-{i}/{name}").id for name in ("left", "right", "top", "bottom")}
        offsets = np.array([data.geom_xpos[beam] - centre for beam in beams.values()])
        left, up = 0.53 * np.asarray(duel.gates.left[i]), np.array([0, 0, 0.53])  # m, beams are 6 cm thick
        np.testing.assert_allclose(offsets, [left, -left, up, -up], atol=1e-6)
        assert not model.geom_contype[list(beams.values())].any()
        assert not model.geom_conaffinity[list(beams.values())].any()


@pytest.mark.parametrize("track", TRACKS.values())
def test_each_wall_cuts_a_straight_way_between_gates_and_none_stands_in_a_start(track):
    gates = np.array([gate[:3] for gate in track.gates])
    ways = np.linspace(gates, np.roll(gates, -1, axis=0), 101)  # (points, gates, 3)
    for wall in track.walls:
        assert wall_gaps((wall,), jnp.asarray(ways.reshape(-1, 3))).min() == 0
    arena = RaceSettings(teams=4, rules=RaceRules(track=next(n for n in TRACKS if TRACKS[n] is track), walls=True))
    built = arena.build(engine="c", threads=1)
    starts = jax.jit(jax.vmap(built.place))(jax.random.split(jax.random.key(0), 64))[0][:, built._pose[:, :3]]
    assert np.all([wall_gaps(track.walls, each).min() > 0.1 for each in starts])
    assert float(starts[..., 2].max()) < 3.0
    assert float(jnp.abs(starts[..., 1]).max()) < 9.0


def test_the_gap_to_walls_is_that_to_the_nearest_side_or_corner():
    walls = (Wall(0.0, 0.0, 1.0, 0.5), Wall(5.0, 0.0, 0.5, 0.5))
    gaps = wall_gaps(walls, jnp.array([[2.0, 0.0, 1.0], [1.3, 0.9, 1.0], [0.5, 0.2, 1.0], [7.0, 0.0, 9.0]]))
    np.testing.assert_allclose(gaps, [1.0, 0.5, 0.0, 1.5], rtol=1e-6)


# Ends of flights ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "time", "ends"),
    [
        ((0.0, 0.0, 1.0), 2.0, False),
        ((-6.1, 0.0, 1.0), 2.0, True), ((5.1, 0.0, 1.0), 2.0, True),
        ((0.0, 9.1, 1.0), 2.0, True), ((0.0, 0.0, 3.1), 2.0, True),
        ((0.0, 0.0, 0.09), 0.9, False), ((0.0, 0.0, 0.09), 1.1, True),
    ],
)  # fmt: skip
def test_a_flight_ends_outside_of_the_box_and_near_the_ground_after_the_take_off(duel, place, time, ends):
    game, verdict = judged(duel, state(duel), {0: place}, {0: place}, time)
    assert game.flying.tolist() == [not ends, True]
    assert verdict.rewards["death"].tolist() == [-2.0 if ends else 0.0, 0.0]
    assert verdict.events["crash"].tolist() == [ends, False]
    assert not verdict.terminated


def test_drones_touch_within_their_spheres_and_too_many_touches_end_both_flights(duel):
    near, far = {0: (0.0, 0.0, 1.0), 1: (0.0, 0.146, 1.0)}, {0: (0.0, 0.0, 1.0), 1: (0.0, 0.148, 1.0)}
    game, verdict = judged(duel, state(duel, contacts=(3, 99)), near, near)  # 2 × 0.0685 + 0.01 m apart
    assert game.contacts.tolist() == [4, 100]
    np.testing.assert_allclose(verdict.rewards["contact"], [-0.1, -0.1])
    assert game.flying.all()
    assert judged(duel, game, far, far)[0].contacts.tolist() == [4, 100]
    game, verdict = judged(duel, game, near, near)
    assert game.flying.tolist() == [True, False]
    assert not verdict.terminated


def test_walls_are_touched_only_where_they_stand():
    walled = RaceSettings(rules=RaceRules(walls=True)).build(engine="c", threads=1)
    assert walled.scene.model.nbody == RaceSettings().build(engine="c").scene.model.nbody + 4
    beside = {0: (0.17, 3.5, 1.0)}  # 0.07 m from the first wall
    assert judged(walled, state(walled), beside, beside)[0].contacts.tolist() == [1, 0]


def test_who_is_out_passes_nothing_earns_nothing_and_falls(duel):
    out = state(duel, flying=(False, True))
    before, after = {0: (0.95, -1.0, 2.0)}, {0: (1.05, -1.0, 2.0)}
    game, verdict = judged(duel, out, before, after, rates={0: (1.0, 1.0, 1.0)})
    assert game.passed.tolist() == [0, 0]
    assert all(float(term[0]) == 0.0 for term in (*verdict.rewards.values(), *verdict.shapings.values()))
    assert duel.alive(at(duel), game).tolist() == [False, True]
    np.testing.assert_allclose(duel.robots["blue/0"].command(jnp.array(duel.robots["blue/0"].limp)), 0.0, atol=1e-6)


# Rewards --------------------------------------------------------------------------------------------------------------


def test_the_first_at_a_gate_is_paid_more_than_those_after_it(four):
    before, after = {1: (0.95, -1.0, 2.0)}, {1: (1.05, -1.0, 2.0)}
    for others, first, later in (((0, 0, 0), 10, 0), ((1, 0, 0), 0, 5), ((1, 3, 0), 0, 2.5), ((1, 1, 2), 0, 1.25)):
        passed = (others[0], 0, *others[1:])
        _, verdict = judged(four, state(four, passed=passed, moments=(0.5, 0, 0.6, 0.7)), before, after)
        assert verdict.rewards["first"].tolist() == [0, first, 0, 0]
        assert verdict.rewards["later"].tolist() == [0, later, 0, 0]


def test_of_two_in_one_step_the_earlier_at_the_plane_is_first(duel):
    before, after = {0: (0.95, -1.2, 2.0), 1: (0.97, -0.8, 2.0)}, {0: (1.05, -1.2, 2.0), 1: (1.05, -0.8, 2.0)}
    _, verdict = judged(duel, state(duel), before, after)
    assert verdict.rewards["first"].tolist() == [0, 10]
    assert verdict.rewards["later"].tolist() == [5, 0]
    _, both = judged(duel, state(duel), {**before, 1: (0.95, -0.8, 2.0)}, after)
    assert both.rewards["first"].tolist() == [10, 10]


def test_rates_cost_by_their_squares_and_progress_is_metres_nearer_to_the_gate(duel):
    before, after = {0: (-1.0, -1.0, 2.0)}, {0: (-0.9, -1.0, 2.0)}
    _, verdict = judged(duel, state(duel), before, after, rates={0: (1.0, 2.0, 3.0)})
    np.testing.assert_allclose(verdict.rewards["rates"], [-0.15 * STEP * 5, 0.0], rtol=1e-6)
    np.testing.assert_allclose(verdict.rewards["yaw"], [-0.05 * STEP * 9, 0.0], rtol=1e-6)
    np.testing.assert_allclose(verdict.shapings["progress"], [0.1, 0.0], atol=1e-6)


# Ends and scores ------------------------------------------------------------------------------------------------------


def test_the_first_to_complete_the_lap_wins_and_ends_the_race(duel):
    before, after = {1: (0.95, -1.0, 2.0)}, {1: (1.05, -1.0, 2.0)}
    game, verdict = judged(duel, state(duel, gate=5, passed=(5, 5), moments=(1.5, 1.9)), before, after)
    assert game.passed.tolist() == [5, 6]
    assert (bool(verdict.terminated), bool(verdict.truncated)) == (True, False)
    assert verdict.score.tolist() == [0, 1]
    assert verdict.rewards["lap"].tolist() == [0, 50]
    assert verdict.events["lap"].tolist() == [False, True]


@pytest.mark.parametrize(
    ("passed", "moments", "score"),
    [((3, 2), (9, 1), (1, 0)), ((3, 3), (9, 8), (0, 1)), ((0, 0), (0, 0), (0.5, 0.5)), ((2, 2), (4, 4), (0.5, 0.5))],
)
def test_time_ends_a_race_for_the_drone_with_more_gates_or_the_same_earlier(duel, passed, moments, score):
    game = state(duel, passed=passed, moments=moments, flying=(True, False))
    assert not judged(duel, game, {}, {}, time=29.9)[1].terminated
    _, verdict = judged(duel, game, {}, {}, time=30.0)
    assert (bool(verdict.terminated), bool(verdict.truncated)) == (True, False)
    assert verdict.score.tolist() == list(score)


def test_a_race_without_a_flying_drone_is_over(duel):
    low = {0: (0.0, 0.0, 0.05)}
    _, verdict = judged(duel, state(duel, passed=(1, 2), moments=(1, 1), flying=(True, False)), low, low)
    assert bool(verdict.terminated)
    assert verdict.score.tolist() == [0, 1]


def test_four_are_ranked(four):
    game = state(four, passed=(2, 4, 2, 0), moments=(3.0, 5.0, 2.5, 0.0))
    _, verdict = judged(four, game, {}, {}, time=30.0)
    np.testing.assert_allclose(mean_pairwise_score(verdict.score), [1 / 3, 1, 2 / 3, 0], rtol=1e-6)


def test_places_for_drones_that_do_not_race_are_zeros():
    roomy = replace(RaceSettings(), teams=1, room=3).build(engine="c", worlds=1)
    four = replace(RaceSettings(), teams=4).build(engine="c", worlds=1)
    alone = RaceSettings(teams=1).build(engine="c", worlds=1)
    assert roomy.observation_size("blue/0") == four.observation_size("blue/0")
    seen, own = (np.asarray(jax.jit(arena.reset)(jax.random.key(0)).observations["blue/0"]) for arena in (roomy, alone))
    assert (seen[: len(own)] == own).all()
    assert not seen[len(own) :].any()


def test_one_alone_succeeds_with_the_lap():
    alone = RaceSettings(teams=1).build(engine="c", threads=1)
    before, after = {0: (0.95, -1.0, 2.0)}, {0: (1.05, -1.0, 2.0)}
    assert judged(alone, state(alone, gate=5, passed=5), before, after)[1].score.tolist() == [1]
    assert judged(alone, state(alone, gate=0, passed=4), before, after)[1].score.tolist() == [0]
    assert alone.teams[0].agents[0].observation_size == RaceSettings().observation_size


# Observations, contract and scripts -----------------------------------------------------------------------------------


def test_a_drone_sees_its_next_gates_and_the_other_in_its_own_frame(duel):
    physics = at(duel, {0: (0.0, -1.0, 2.0), 1: (0.0, 1.0, 2.0)})
    turned = np.array(physics.qpos)
    turned[3:7] = np.sqrt([0.5, 0, 0, 0.5])  # blue looks along +y
    moving = np.array(physics.qvel)
    moving[6:9] = (1.0, 0.0, 0.0)
    physics = physics._replace(qpos=jnp.asarray(turned), qvel=jnp.asarray(moving))
    game = state(duel, passed=(0, 2), contacts=(25, 0))
    seen = observing(duel)(physics, game, {name: jnp.zeros(4) for name in duel.robots})["blue/0"]
    np.testing.assert_allclose(seen[9:12], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(seen[12:18], [0, -1, 2, 0, 0.25, 2 / 30], atol=1e-6)
    wanted = [[0.5, -1, 0.5], [-0.5, -1, 0.5], [-0.5, -1, -0.5], [0.5, -1, -0.5]]
    np.testing.assert_allclose(read(seen).gates[0], wanted, atol=1e-6)
    np.testing.assert_allclose(seen[42:], [2, 0, 0, 0, -1, 0, 2, 1], atol=1e-6)
    (others,) = duel.observation_entities("blue/0")
    assert others.places == (tuple(range(42, 50)),)
    gone = observing(duel)(
        physics, game._replace(flying=jnp.array([True, False])), {n: jnp.zeros(4) for n in duel.robots}
    )
    np.testing.assert_allclose(gone["blue/0"][42:], [0, 0, 0, 0, 0, 0, 2, 0])


class Favoured(Race):
    """The first team's gates count from the start."""

    def observe(self, physics, game, actions):
        found = super().observe(physics, game, actions)
        return {**found, "blue/0": found["blue/0"].at[15].add(0.5)}


SHORT = RaceSettings(rules=RaceRules(episode=1.0, take_off=0.2, walls=True))


@pytest.mark.slow
@pytest.mark.parametrize("teams", [1, 2, 3])
def test_it_keeps_the_contract_and_its_teams_can_change_places(teams):
    settings = replace(SHORT, teams=teams)
    arena = settings.build(engine="c", worlds=WORLDS)
    assert exchangeable(arena) == ([list(range(teams))] if teams > 1 else [])
    assert [check for check in check_arena(arena, settings) if not check.ok] == []


def test_teams_that_cannot_change_places_fail_the_check():
    assert "the observation of" in problem(CheckRun(Favoured(SHORT, engine="c"), jax.random.key(0)))


@pytest.mark.parametrize("track", TRACKS)
def test_the_pilot_completes_laps_from_any_gate_and_beats_the_cadet(track):
    arena = RaceSettings(rules=RaceRules(track=track)).build(engine="c", worlds=24)
    scripts = {"blue/0": arena.scripts()["pilot"], "red/0": arena.scripts()["cadet"]}

    @jax.jit
    def play(keys):
        def decide(state, key):
            acts = {name: scripts[name]["crazyflie-rates"](state.observations[name], key) for name in scripts}
            return arena.step(state, acts), None

        def episode(key):
            return jax.lax.scan(decide, arena.reset(key), jax.random.split(key, 700))[0]

        return jax.vmap(episode)(keys)

    end = play(jax.random.split(jax.random.key(0), 24))
    assert set(np.asarray(end.game.gate).tolist()) == set(range(6))
    assert np.asarray(end.done).all()
    assert np.asarray(end.verdict.score)[:, 0].mean() > 0.9
    assert (np.asarray(end.game.passed)[:, 0] == 6).mean() > 0.9
