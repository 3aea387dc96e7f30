"""The disturbed walk: what nature does to the walker, what both get for it, and robots that move in a plane."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.arena_settings import Table
from arenas.contract.check import check_arena
from arenas.contract.check_run import CheckRun
from arenas.contract.checks import CHECKS
from arenas.errors import ArenaError, EngineError
from arenas.games.disturbance import DisturbanceSettings
from arenas.games.disturbance.settings import DisturbanceRules, check_design, check_terrain
from arenas.games.walk import RobotWalkSettings
from arenas.scene.height_fields import HeightField, Terrain

pytest.importorskip("gymnasium")
SHORT = DisturbanceRules(episode=1.0, force=20.0, weight_share=0.0)
HOPPER = DisturbanceSettings(blue=("hopper",), bodies=("base", "foot"), rules=SHORT)
BOTH = replace(HOPPER, design=Table({"friction": [0.5, 2.0], "foot": [0.5, 3.0]}))
ALONE = replace(HOPPER, bodies=())
KEYS = jax.random.split(jax.random.key(0), 3)


def built(settings, **options):
    return settings.build(**{"engine": "c", "threads": 1, **options})


@pytest.fixture(scope="module")
def hopper():
    return built(HOPPER)


@pytest.fixture(scope="module")
def both():
    return built(BOTH)


def zeros(arena, **changed):
    acts = {agent.name: jnp.zeros((len(KEYS), agent.action_size)) for agent in arena.agents}
    return acts | {name.replace("_", "/"): jnp.broadcast_to(jnp.asarray(a), acts[name.replace("_", "/")].shape)
                   for name, a in changed.items()}  # fmt: skip


@cache
def compiled(arena):
    """Reset, step and restart of three worlds."""
    return tuple(jax.jit(jax.vmap(each)) for each in (arena.reset, arena.step, arena.restart))


def played(arena, decisions, **changed):
    """States (3 worlds) after each decision of the same actions."""
    reset, step, _ = compiled(arena)
    state, found = reset(KEYS), []
    for _ in range(decisions):
        state = step(state, zeros(arena, **changed))
        found.append(state)
    return found


# Forces ---------------------------------------------------------------------------------------------------------------


def test_a_push_moves_the_walker_and_is_bounded(hopper):
    still, ahead, harder, up = (
        played(hopper, 10, nature_0=push)[-1].physics.qvel[:, 0]
        for push in ([0.0] * 4, [1, 0, 0, 0], [9, 0, 0, 0], [0, 1, 0, 0])
    )
    assert (ahead > still + 0.05).all()
    np.testing.assert_array_equal(harder, ahead)
    assert (jnp.abs(up - still) < jnp.abs(ahead - still)).all()


def test_forces_are_told_to_recordings_beside_the_goal(hopper):
    assert hopper.drawn_kinds == {"goal": "circle", "blue/0/torso": "force", "blue/0/foot": "force"}
    state = hopper.reset(KEYS[0])
    acts = {"blue/0": jnp.zeros(3), "nature/0": jnp.array([0.5, 0.0, -4.0, 1.0])}
    _, frames = jax.jit(hopper.step_with_frames)(state, acts)
    np.testing.assert_allclose(frames.markers["blue/0/torso"][-1], [10.0, 0.0, 0.0, 20.0 * 2**0.5], rtol=1e-6)
    np.testing.assert_allclose(frames.markers["blue/0/foot"][-1], [-20.0, 0.0, 20.0, 20.0 * 2**0.5], rtol=1e-6)


def test_its_limit_is_the_larger_of_newtons_and_a_share_of_the_weight(hopper):
    assert hopper.limit == 20.0
    heavy = replace(HOPPER, rules=replace(SHORT, weight_share=0.2))
    model = hopper.scene.model
    assert built(heavy).limit == pytest.approx(0.2 * 9.81 * model.body_mass.sum())
    push = hopper.robots["nature/0"].push
    np.testing.assert_allclose(push.wrench(jnp.ones(4))[:, :3], [[20.0, 0.0, 20.0]] * 2)


def test_nature_gets_the_opposite_and_pays_for_its_force(hopper):
    verdict = played(hopper, 1, nature_0=[1.0, 1.0, 0.0, 0.0])[-1].verdict
    for name, term in verdict.rewards.items():
        if name != "force":
            np.testing.assert_allclose(term[:, 0], -term[:, 1], err_msg=name)
    np.testing.assert_allclose(verdict.rewards["force"], [[0.0, -0.1 * 0.02 * 0.5]] * 3, rtol=1e-5)
    assert np.abs(verdict.rewards["tracking"]).max() > 0


def test_only_a_nature_that_pushes_has_the_script_headwind(hopper, both, hills):
    has = [arena.playable_scripts(arena.teams[1]) for arena in (hopper, both, hills)]
    assert ["headwind" in scripts for scripts in has] == [True, True, False]  # hills: a designer alone


def test_a_fall_or_the_end_of_the_time_is_nature_s(hopper):
    fallen = played(hopper, 51, nature_0=[-1.0, 0.0, 1.0, 0.0])[-1]
    assert fallen.done.all()
    np.testing.assert_array_equal(fallen.verdict.score, [[0.0, 1.0]] * 3)
    assert fallen.verdict.terminated.all()
    assert played(hopper, 40, blue_0=[0.0, 0.0, 0.0])[-1].verdict.events["reached"].shape == (3, 2)


def test_an_undisturbed_walk_is_the_walk_alone(hopper):
    alone = built(ALONE)
    assert [team.name for team in alone.teams] == ["blue"]
    assert alone.agents[0] == hopper.agents[0]
    for one, other in zip(played(hopper, 8), played(alone, 8), strict=True):
        np.testing.assert_allclose(one.physics.qpos, other.physics.qpos, atol=1e-6)
        np.testing.assert_allclose(one.observations["blue/0"], other.observations["blue/0"], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jax", "warp"])
def test_engines_agree_on_a_disturbed_and_designed_walk(name, both):
    acts = {"nature_0": [0.5, 1.0, -1.0, 0.2], "nature_1": [1.0, -0.5]}
    other = built(BOTH, engine=name, worlds=3)
    for one, found in zip(played(both, 5, **acts), played(other, 5, **acts), strict=True):
        np.testing.assert_allclose(found.physics.qpos, one.physics.qpos, atol=1e-5)
        np.testing.assert_allclose(found.physics.model["body_mass"], one.physics.model["body_mass"], rtol=1e-6)


# The first decision ---------------------------------------------------------------------------------------------------


def test_the_first_decision_sets_masses_and_friction_and_later_ones_nothing(both):
    model, foot = both.scene.model, both.scene.model.body("blue/0/foot").id
    first = played(both, 1, nature_1=[1.0, 5.0])[0]  # the second is clipped
    assert first.alive.tolist() == [[True, True, False]] * 3
    np.testing.assert_allclose(first.physics.model["body_mass"][:, foot], 3.0 * model.body_mass[foot], rtol=1e-6)
    np.testing.assert_allclose(
        first.physics.model["body_inertia"][:, foot][0], 3.0 * model.body_inertia[foot], rtol=1e-6
    )
    np.testing.assert_allclose(
        first.physics.model["geom_friction"][0, 1:, 0], 2.0 * model.geom_friction[1:, 0], rtol=1e-6
    )
    np.testing.assert_allclose(first.physics.model["geom_friction"][0, 0], model.geom_friction[0], rtol=1e-6)
    np.testing.assert_allclose(first.game.nature.factors, [[2.0, 3.0]] * 3)
    np.testing.assert_allclose(first.observations["nature/0"][:, -2:], [[2.0, 3.0]] * 3)
    _, step, restart = compiled(both)
    again = step(first, zeros(both, nature_1=[-1.0, -1.0]))
    for name, field in again.physics.model.items():
        np.testing.assert_array_equal(field, first.physics.model[name], err_msg=name)
    begun = restart(again, KEYS, jnp.array([True, False, False]))
    assert begun.alive.tolist() == [[True, True, True], [True, True, False], [True, True, False]]
    np.testing.assert_allclose(begun.physics.model["body_mass"][0], model.body_mass, rtol=1e-6)


def test_a_heavier_foot_changes_the_walk(both):
    light, heavy = (played(both, 10, blue_0=[0.3, -0.3, 0.3], nature_1=[0.0, mass])[-1] for mass in (-1.0, 1.0))
    assert np.abs(light.physics.qpos - heavy.physics.qpos).max() > 1e-3


def test_what_was_set_is_told_to_recordings(both, hopper):
    actions = {agent.name: np.zeros(agent.action_size) for agent in both.agents} | {"nature/1": np.array([-1.0, 9.0])}
    assert both.describe_design(actions) == "nature/1 sets friction 0.5, foot 3"
    assert hopper.describe_design(actions) == ""


def test_a_field_that_randomise_does_not_draw_is_told():
    arena = built(BOTH)
    arena.design = lambda physics, game: (physics.qpos, physics.qvel, {"dof_damping": jnp.zeros(6)})
    with pytest.raises(ArenaError, match=r"^design sets dof_damping: return the model's values in randomise too"):
        jax.eval_shape(
            lambda key: arena.step(arena.reset(key), {a.name: jnp.zeros(a.action_size) for a in arena.agents}), KEYS[0]
        )


# The ground -----------------------------------------------------------------------------------------------------------


HILLS = replace(
    HOPPER, bodies=(), terrain=Table({"bumps": 0.1, "terraces": 0.3}),
    design=Table({"friction": [0.5, 2.0], "terrain": ["flat", "terraces", "bumps"]}),
)  # fmt: skip
BUMPS = replace(  # MJX compiles each field for half a minute
    HILLS, terrain=Table({"bumps": 0.3}), design=Table({"friction": [0.5, 2.0], "terrain": ["flat", "bumps"]})
)
CHOICES = jnp.array([[0.0, -1.0], [0.0, 0.0], [0.0, 9.0]])  # the last is clipped


@pytest.fixture(scope="module")
def hills():
    return built(HILLS)


def dropped(arena, decisions=10):
    """The worlds after some decisions, each on another field, where the hopper begins above the highest bump."""
    reset, step, _ = compiled(arena)
    state, bumps = reset(KEYS), arena.terrain.fields[0]
    highest = 1.0 + 0.25 * float(bumps.heights[bumps.heights.shape[0] // 2].argmax())
    over = state.physics.qpos.at[:, 0].set(highest).at[:, 1].add(0.3)
    make = jax.jit(jax.vmap(arena.engine.make))
    state = state._replace(physics=make(over, state.physics.qvel, state.physics.model))
    found = []
    for _ in range(decisions):
        state = step(state, {"blue/0": jnp.zeros((3, 3)), "nature/0": CHOICES})
        found.append(state)
    return found


def test_the_first_decision_puts_one_height_field_in_place(hills):
    first = played(hills, 1, nature_0=CHOICES)[0]
    bodies = [hills.scene.model.body(f"{name}/body").id for name in ("bumps", "terraces")]
    heights = first.physics.model["body_pos"][:, jnp.array(bodies), 2]
    np.testing.assert_allclose(heights, [[-100.0, -100.0], [-100.0, -0.01], [-0.01, -100.0]])
    np.testing.assert_allclose(first.game.nature.factors[:, 1], [0.0, 1.0, 2.0])
    _, step, restart = compiled(hills)
    again = step(first, zeros(hills, nature_0=-CHOICES))
    np.testing.assert_array_equal(again.physics.model["body_pos"], first.physics.model["body_pos"])
    begun = restart(again, KEYS, jnp.array([False, False, True]))
    np.testing.assert_allclose(begun.physics.model["body_pos"][2, jnp.array(bodies), 2], [-100.0, -100.0])


def test_a_chosen_field_carries_the_walker(hills):
    read = jax.jit(jax.vmap(lambda physics: hills._heights.read(physics.qpos).feet[0]))  # above the flat ground
    flat, terrace, bump = np.min([read(state.physics) for state in dropped(hills, 30)], axis=0)
    assert flat < 0.01
    assert terrace > 0.1
    assert bump > flat + 0.015


@pytest.mark.slow
def test_engines_agree_on_the_chosen_ground():
    """To the first contact with a bump, which then also MJX holds against the walker, with contacts of its own."""
    one, other = (dropped(built(BUMPS, engine=engine), 8) for engine in ("c", "jax"))
    for c, mjx in zip(one[:3], other[:3], strict=True):
        np.testing.assert_allclose(mjx.physics.model["body_pos"], c.physics.model["body_pos"], atol=1e-6)
        np.testing.assert_allclose(mjx.physics.qpos, c.physics.qpos, atol=1e-5)
    flat, *held = other[-1].physics.qpos[:, 1]
    assert min(held) - flat > 0.05


def test_an_engine_that_cannot_choose_the_ground_says_so():
    with pytest.raises(EngineError, match=r"^engine warp cannot choose among height fields in each world: take engine"):
        Terrain(mujoco.MjModel.from_xml_string("<mujoco/>"), [HeightField.of("bumps", 0.1, 10.0)], "warp")


def test_heights_are_above_the_ground_that_is_there(hills):
    model, data = hills.scene.model, mujoco.MjData(hills.scene.model)
    number, field = 2, hills.terrain.fields[1]
    places = hills.terrain.placed(jnp.asarray(model.body_pos, jnp.float32), jnp.asarray(number))
    before, model.body_pos[:] = model.body_pos.copy(), places
    mujoco.mj_forward(model, data)
    model.body_pos[:] = before
    for x in np.linspace(0.5, 12.5, 13):
        down = mujoco.mj_ray(
            model, data, [x, 0.33, 5.0], [0.0, 0.0, -1.0], None, 1, model.body("blue/0/torso").id, np.zeros(1, np.int32)
        )
        at = jnp.array([x, 0.33])
        assert float(field.height(at)) == pytest.approx(5.0 - down, abs=1e-5)
        assert float(hills.terrain.height(places, at)) == float(field.height(at))


def test_a_robot_s_own_rule_of_a_fall_counts_from_the_ground_below_it(hills):
    model, standing = hills.scene.model, jnp.asarray(hills.scene.rest, jnp.float32).at[0].set(6.0)

    @jax.jit
    def fallen(number):
        places = hills.terrain.placed(jnp.asarray(model.body_pos, jnp.float32), number)
        ground = hills.terrain.height(places, jnp.array([6.0, 0.0]))

        def fallen_above(lower):
            qpos = standing.at[1].add(ground - lower)
            physics = SimpleNamespace(qpos=qpos, qvel=jnp.zeros(model.nv), model={"body_pos": places})
            body = hills.body("blue/0", physics, {"blue/0": jnp.zeros(3)})
            return hills.down(physics, body, hills.heights(physics, body)), hills.fallen(physics)[0]

        return jax.vmap(fallen_above)(jnp.linspace(0.0, 0.9, 10)), ground

    (flat, _), (terraces, height) = fallen(0), fallen(2)
    assert height > 0.25
    assert 0 < flat[1].sum() < 10
    np.testing.assert_array_equal(terraces, flat)


def test_without_a_choice_each_episode_draws_its_ground():
    arena = built(replace(HILLS, design=Table()))
    keys = jax.random.split(jax.random.key(1), 60)
    bodies = jnp.array([arena.scene.model.body(f"{name}/body").id for name in ("bumps", "terraces")])
    places = jax.jit(jax.vmap(lambda key: arena.randomise(key)["body_pos"]))(keys)[:, bodies, 2]
    there = np.asarray(places) > -1.0
    assert (there.sum(axis=1) <= 1).all()
    assert there.any(axis=0).all()
    assert not there.any(axis=1).all()


def test_the_chosen_ground_is_told_to_recordings(hills):
    actions = {"blue/0": np.zeros(3), "nature/0": np.array([1.0, -0.2])}
    assert hills.describe_design(actions) == "nature/0 sets friction 2, terrain terraces"
    robot = hills.robots["nature/0"]
    assert robot.designed(jnp.linspace(-1, 1, 7)[:, None] * jnp.ones(2))[:, 1].tolist() == [0, 0, 1, 1, 2, 2, 2]


@pytest.mark.slow
def test_a_walk_on_height_fields_keeps_the_contract(hills):
    short = replace(HILLS, rules=replace(SHORT, episode=0.2))
    assert [check for check in check_arena(built(short), short) if not check.ok] == []


def test_a_design_that_sets_nothing_or_again_is_found(monkeypatch, hills):
    run = CheckRun(hills, jax.random.key(0))
    check = CHECKS["a first decision sets what its agent declares, and later ones nothing"]
    assert check(run) == ""
    monkeypatch.setattr(hills.terrain, "placed", lambda body_pos, number: body_pos)
    told = "nature/0 sets terrain, and the world is the same with flat and bumps"
    assert check(CheckRun(hills, jax.random.key(0))) == told


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"bodies": ("nose",)}, "bodies: hopper has no body nose; it has torso, thigh, leg, foot"),
        ({"bodies": ("torso", "base")}, "bodies: torso is named twice"),
        ({"design": Table({"nose": [0.5, 2.0]})}, "design: hopper has no body nose; it has torso, thigh, leg, foot"),
    ],
)
def test_bodies_that_are_not_there_are_told_in_one_line(changed, message):
    with pytest.raises(ArenaError) as told:
        built(replace(HOPPER, **changed))
    assert str(told.value) == message


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            {"design": {"terrain": ["flat", "bumps"]}},
            "design: terrain: the arena has no height field; give it some, terrain = {bumps = 0.1}",
        ),
        (
            {"terrain": {"bumps": 0.1}, "design": {"terrain": ["flat", "pits"]}},
            "design: terrain: 'pits' is none of the arena's: flat, bumps",
        ),
        (
            {"terrain": {"bumps": 0.1}, "rules": DisturbanceRules(distance=101.0)},
            "terrain: its height fields reach 100 m, and the goal is further away",
        ),
    ],
)
def test_ground_that_is_not_there_is_told_in_one_line(flags, message):
    with pytest.raises(ValueError) as told:  # noqa: PT011
        DisturbanceSettings(**{n: Table(v) if isinstance(v, dict) else v for n, v in flags.items()})
    assert str(told.value) == message


@pytest.mark.parametrize(
    ("check", "table", "message"),
    [
        (check_terrain, {"pits": 0.1}, "'pits' is no height field: bumps, terraces, waves"),
        (check_terrain, {"bumps": 2}, "bumps: 2 must be its greatest height, from 0.02 to 1 m"),
        (check_terrain, {"bumps": True}, "bumps: True must be its greatest height, from 0.02 to 1 m"),
        (
            check_design,
            {"terrain": ["flat"]},
            "terrain: ['flat'] must be the names of two or more height fields, as [flat, bumps]",
        ),
        (
            check_design,
            {"terrain": [0, 1]},
            "terrain: [0, 1] must be the names of two or more height fields, as [flat, bumps]",
        ),
    ],
)
def test_tables_of_the_ground_are_checked(check, table, message):
    with pytest.raises(ValueError) as told:  # noqa: PT011
        check(table)
    assert str(told.value) == message


def test_bounds_and_bodies_are_part_of_the_configuration_hash(hopper, both):
    other = built(replace(BOTH, design=Table({"friction": [0.5, 1.5], "foot": [0.5, 3.0]})))
    foot = built(replace(HOPPER, bodies=("foot",)))
    assert len({each.config_hash for each in (hopper, both, other, foot)}) == 4


def test_a_robot_that_moves_in_a_plane_plays_nowhere_else():
    with pytest.raises(ValueError, match=r"^blue: hopper moves in a plane alone, and plays in arena disturbance only$"):
        RobotWalkSettings(blue=("hopper",))
