"""What an engine cannot collide is refused at load, with both geoms named; what we say it can, it does."""

import re
from itertools import combinations_with_replacement

import jax
import jax.numpy as jnp
import mujoco
import pytest
from mujoco import mjx
from mujoco.mjx._src.collision_driver import geom_pairs

from arenas.arena_settings import Solver
from arenas.errors import EngineError
from arenas.physics.collisions import TYPES, UNSUPPORTED, colliding_pairs
from arenas.physics.mjx import MjxEngine
from arenas.physics.registry import make_engine
from arenas.robots.puck import PUCK
from arenas.scene.props import Prop, block
from arenas.scene.scene import build

ASSETS = """
  <asset>
    <mesh name="brick" vertex="-1 -1 -1  1 -1 -1  -1 1 -1  1 1 -1  -1 -1 1  1 -1 1  -1 1 1  1 1 1" scale=".1 .11 .1"/>
    <hfield name="hill" nrow="3" ncol="3" size=".4 .4 .1 .1" elevation="0 0 0 0 1 0 0 0 0"/>
  </asset>
"""
SHAPES = {  # and how high each one reaches, m
    "plane": ('type="plane" size=".4 .4 .1"', 0.0), "hfield": ('type="hfield" hfield="hill"', 0.1),
    "sphere": ('type="sphere" size=".1"', 0.1), "capsule": ('type="capsule" size=".1 .1"', 0.2),
    "ellipsoid": ('type="ellipsoid" size=".1 .12 .15"', 0.15), "cylinder": ('type="cylinder" size=".1 .1"', 0.1),
    "box": ('type="box" size=".1 .1 .1"', 0.1), "mesh": ('type="mesh" mesh="brick"', 0.1),
    "sdf": ('type="sdf" mesh="brick"', 0.1),
}  # fmt: skip
KINDS = list(SHAPES)
PAIRS = [(KINDS[a], KINDS[b]) for a, b in combinations_with_replacement(TYPES, 2) if b > 1]  # ground never meets ground
DEEP = 0.02  # m by which the upper one is in the lower
FALLING = -9.81 * 0.002  # m/s after one step of what nothing holds


def refused(engine):
    return {(KINDS[a], KINDS[b]) for a, b in UNSUPPORTED[engine]}


def scene(pairs, alone=False):
    """Each pair 3 m from the next: `A-B/two` stands on, and in, `A-B/one`, which is free too if it is no ground.

    Where they are `alone`, nothing can meet but the two of a pair.
    """
    bits = 'contype="0" conaffinity="0"' if alone else ""
    bodies = [standing(*pair, (3 * (i % 8), 3 * (i // 8)), bits) for i, pair in enumerate(pairs)]
    told = [f'<pair geom1="{a}-{b}/one" geom2="{a}-{b}/two"/>' for a, b in pairs if alone]
    return mujoco.MjModel.from_xml_string(
        f"<mujoco>{ASSETS}<worldbody>{''.join(bodies)}</worldbody><contact>{''.join(told)}</contact></mujoco>"
    )


def standing(a, b, at, attributes):
    (lower, low), (upper, high) = SHAPES[a], SHAPES[b]
    one = f'<geom name="{a}-{b}/one" {lower} {attributes} {{}}/>'
    place = f'pos="{at[0]} {at[1]} {{}}"'
    fixed = a in ("plane", "hfield")
    below = one.format(place.format(0)) if fixed else f"<body {place.format(0)}><freejoint/>{one.format('')}</body>"
    two = f'<geom name="{a}-{b}/two" {upper} {attributes}/>'
    return f"{below}<body {place.format(low + high - DEEP)}><freejoint/>{two}</body>"


@pytest.mark.parametrize("pair", [pytest.param(pair, id="-".join(pair)) for pair in PAIRS])
def test_mjx_raises_for_what_we_refuse_and_for_nothing_else(pair):
    model = scene([pair])
    if pair in refused("jax"):
        with pytest.raises(NotImplementedError, match="collisions not implemented"):
            mjx.put_model(model, impl="jax")
        told = r"^engine jax cannot collide {0}-{1}/one \({0}\) with {0}-{1}/two \({1}\): "
        with pytest.raises(EngineError, match=told.format(*pair)):
            make_engine("jax", model)
    else:
        assert make_engine("jax", model).name == "jax"


@pytest.mark.slow
def test_warp_draws_meshes_into_sdfs_far_from_the_origin():
    """Or does it no longer? Then it need not be refused."""
    model = scene([("mesh", "sdf")])
    with pytest.raises(EngineError, match=r"^engine warp cannot collide mesh-sdf/one \(mesh\) with .*: use engine c; "):
        make_engine("warp", model)
    warp = MjxEngine(model, impl="warp", buffers=Solver(contacts=200, rows=1000))
    qpos = jnp.asarray(model.qpos0, jnp.float32).at[jnp.array([0, 7])].add(1.0)
    after = jax.jit(lambda q: warp.step(warp.make(q, jnp.zeros(model.nv)), jnp.zeros(0), 1))(qpos)
    assert after.qvel[8] < 1.5 * FALLING


@pytest.mark.parametrize("name", sorted(UNSUPPORTED))
def test_nobody_collides_what_no_engine_can(name):
    (pair,) = refused("c")
    with pytest.raises(
        EngineError, match=rf"^engine {name} cannot collide .*: no engine can collide all of these; or make one "
    ):
        make_engine(name, scene([pair]))
    model = scene([pair])  # and that is so
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


# One small scene of bodies in pairs; MJX and Warp take a minute to compile so many kinds of contact. On MJX the capsule
# falls into the hill where XLA optimises little.
@pytest.mark.parametrize(
    "name",
    [
        "c",
        pytest.param("jax", marks=[pytest.mark.slow, pytest.mark.optimised]),
        pytest.param("warp", marks=pytest.mark.slow),
    ],
)
def test_what_an_engine_takes_it_pushes_apart(name):
    pairs = [pair for pair in PAIRS if pair not in refused(name)]
    model = scene(pairs, alone=True)
    engine = make_engine(name, model, buffers=Solver(contacts=1000, rows=6000))
    physics = jax.jit(engine.make)(jnp.asarray(model.qpos0, jnp.float32), jnp.zeros(model.nv))
    after = jax.jit(lambda p: engine.step(p, jnp.zeros(0), 1))(physics)
    assert not after.unstable
    up = {geom: float(after.qvel[dof + 2]) for geom, dof in movers(model).items()}
    assert not [pair for pair in pairs if up[f"{'-'.join(pair)}/two"] < 0.9 * FALLING]


def movers(model):
    """Geoms of free bodies -> the first of their velocities."""
    return {model.geom(int(model.body_geomadr[model.dof_bodyid[dof]])).name: dof for dof in range(0, model.nv, 6)}


XML = """
<mujoco>
  {option}
  <worldbody>
    <geom name="ground" type="plane" size="1 1 .1"/>
    <geom name="wall" type="box" size=".1 .1 .1"/>
    <body name="trunk" pos="0 0 1">
      <freejoint/>
      <geom name="trunk" type="ellipsoid" size=".1 .1 .2"/>
      <body name="arm" pos="0 0 .2"><joint/><geom name="arm" size=".1"/>
        <body name="hand" pos="0 0 .2"><geom name="hand" type="box" size=".1 .1 .1"/></body>
      </body>
      <body name="leg" pos="0 0 -.2"><joint/><geom name="leg" type="cylinder" size=".1 .1" conaffinity="0"/></body>
      <body name="hat" pos="0 0 .4"><geom name="hat" size=".1" contype="2" conaffinity="2"/></body>
    </body>
  </worldbody>
  <contact>{contact}</contact>
</mujoco>
"""


@pytest.mark.parametrize("contact", ["", '<exclude body1="leg" body2="arm"/>', '<pair geom1="hat" geom2="hand"/>'])
@pytest.mark.parametrize("option", ["", '<option><flag filterparent="disable"/></option>'])
def test_who_can_meet_is_what_mjx_finds(option, contact):
    """MJX's own list, which only MJX has; C and Warp are tried above by the contacts that they make."""
    model = mujoco.MjModel.from_xml_string(XML.format(option=option, contact=contact))
    found = {frozenset((int(a), int(b))) for a, b, _ in geom_pairs(model)}
    assert found == {frozenset(pair) for pair in colliding_pairs(model)}
    assert len(found) > 5


def test_the_pair_is_named_with_those_who_can():
    lid = Prop("lid", lambda: disc("lid"), free=True)
    model = build({"blue": (PUCK,)}, (block(half=(0.1, 0.1, 0.1), mass=1.0), lid), timestep=0.01).model
    told = (
        "engine jax cannot collide lid/disc (cylinder) with block/block (box): use engine c or warp; or make one of"
        " them a sphere or a capsule, or keep them apart by contype and conaffinity"
    )
    with pytest.raises(EngineError, match=f"^{re.escape(told)}$"):
        make_engine("jax", model)
    assert make_engine("c", model).name == "c"


def disc(name):
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="body", pos=[1, 1, 0.1])
    kind = mujoco.mjtGeom.mjGEOM_CYLINDER
    body.add_geom(name="disc", type=kind, size=[0.1, 0.02, 0], mass=0.1, contype=2, conaffinity=3)
    return spec


def test_a_mesh_with_a_margin_is_refused_where_it_is_ignored():
    xml = f"""<mujoco>{ASSETS}<worldbody><body><freejoint/><geom type="mesh" mesh="brick" margin=".01"/></body>
        <geom name="ground" type="plane" size="1 1 1"/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    told = r"collide ground \(plane\) with geom 1 of body 1 \(mesh\) with a margin: use engine c or warp; or take the m"
    with pytest.raises(EngineError, match=told):
        make_engine("jax", model)


def test_what_else_mjx_cannot_is_one_line():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option integrator="implicitfast" viscosity="1"/><worldbody><body><freejoint/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    with pytest.raises(EngineError, match=r"^engine jax cannot run this model: implicitfast .*; engine c can$"):
        make_engine("jax", model)


TILTED = """
<mujoco>
  <option integrator="implicitfast" cone="pyramidal" iterations="20" ls_iterations="20"/>
  <worldbody>
    <body><freejoint/><geom type="box" size=".25 .15 .05" mass="3.4"/></body>
    <body pos=".3 .1 .12" euler="10 25 40"><freejoint/><geom type="box" size=".25 .15 .05" mass="3.4"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.slow  # Warp compiles for a minute on a CPU
def test_two_boxes_meet_on_warp_as_they_do_in_c():
    ends = {}
    for name in ("c", "warp"):
        model = mujoco.MjModel.from_xml_string(TILTED)
        speeds = jnp.zeros(model.nv).at[8].set(-2.0)  # m/s: the upper one falls onto the other's edge
        engine = make_engine(name, model, buffers=Solver(contacts=16, rows=64))
        physics = jax.jit(engine.make)(jnp.asarray(model.qpos0, jnp.float32), speeds)
        ends[name] = jax.jit(lambda p, engine=engine: engine.step(p, jnp.zeros(0), 40))(physics)
    hit = float(ends["c"].qvel[2])
    assert hit < -0.3 + 40 * FALLING  # it was struck, and does not only fall
    assert jnp.abs(ends["warp"].qpos - ends["c"].qpos).max() < 1e-5  # as any two convex bodies: 0.003
