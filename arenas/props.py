"""Things that are in a game and belong to no team: balls, blocks, walls, goals. Values, placed by `scene.build`.

Collision bits, as all robots here keep them: bit 1 is the ground, bit 2 are bodies. The ground has (contype 1, affinity
0); what stands on it and is pushed about has (2, 3); a wheel that only rolls on the ground has (0, 1).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco

Colour = tuple[float, float, float, float]
_MOVED = {"contype": 2, "conaffinity": 3}  # touches ground, robots and its like
_STANDING = {"contype": 3, "conaffinity": 2}  # touches all that moves
_SEEN = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}  # drawn and never touched

# A bounce takes pi / BOUNCE = 31 ms, six physics steps of 5 ms: a stiffer spring than that gives back what it likes
# (at 200 rad/s 0.55 to 0.86 instead of 0.6), a softer one lets the ball sink in (here 3 cm at 3 m/s).
BOUNCE = 100.0  # rad/s
_ELASTIC = (0.99, 0.99, 0.001, 0.5, 2.0)  # solimp: all of the contact's force is the spring's


@dataclass(frozen=True)
class Prop:
    """A named thing: its body, and whether it can move. Its geoms in the model are called `name/...`.

    `build` gives a spec with one body under the world; the body's position there is where the prop stands in the rest
    pose. A free one gets a free joint by `scene.build`, which tells where its numbers stand in qpos and qvel.
    """

    name: str
    build: Callable[[], mujoco.MjSpec]
    free: bool = False


def ball(
    name: str = "ball", *, radius: float, mass: float, colour: Colour = (0.95, 0.95, 0.92, 1.0),
    friction: tuple[float, float, float] = (0.7, 0.005, 0.0001), restitution: float | None = None, hollow: bool = False,
) -> Prop:  # fmt: skip
    """A ball in metres and kilograms. `friction` is sliding, torsional, rolling, the last two in metres.

    With a `restitution` above 0 it leaves what it hits with that share of its speed (see `bouncing`); without, as
    MuJoCo's contacts have it, it hardly bounces. A `hollow` one has its mass in its skin.
    """
    inertia = mujoco.mjtGeomInertia
    bounce = {} if restitution is None else {"solref": bouncing(restitution), "solimp": _ELASTIC}

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, (0.0, 0.0, radius))
        body.add_geom(
            name="ball", size=[radius, 0, 0], mass=mass, condim=6, priority=2, friction=friction, rgba=colour,
            typeinertia=inertia.mjINERTIA_SHELL if hollow else inertia.mjINERTIA_VOLUME, **bounce, **_MOVED,
        )  # fmt: skip
        return spec

    return Prop(name, build, free=True)


def bouncing(restitution: float) -> tuple[float, float]:
    """MuJoCo's `solref` for a coefficient of restitution in (0, 1]; it has no such number itself.

    In its negative form solref is the stiffness and damping, per unit of mass, of the spring that a contact is. A
    spring of rate w and damping ratio z throws back exp(-pi z / sqrt(1 - z^2)) of the speed it is met with. How much
    one bounce really gives back differs by some hundredths, as physics steps cut the contact where they happen to.
    """
    loss = -math.log(restitution)
    return -(BOUNCE**2), -2.0 * BOUNCE * loss / math.hypot(math.pi, loss)


def block(
    name: str = "block", *, half: tuple[float, float, float], mass: float, at: tuple[float, float] = (0.0, 0.0),
    colour: Colour = (0.72, 0.52, 0.30, 1.0), friction: tuple[float, float, float] = (0.5, 0.005, 0.0001),
) -> Prop:  # fmt: skip
    """A box that can be pushed; `half` are its half sizes in metres, `at` where it stands on the ground."""

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, (*at, half[2]))
        body.add_geom(
            name="block", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, mass=mass, friction=friction, rgba=colour, **_MOVED
        )
        return spec

    return Prop(name, build, free=True)


def wall(
    name: str, *, at: tuple[float, float, float], half: tuple[float, float, float],
    colour: Colour = (0.55, 0.57, 0.60, 1.0),
) -> Prop:  # fmt: skip
    """A box that stands for ever, centre `at` and half sizes in metres."""

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, at)
        body.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=colour, **_STANDING)
        return spec

    return Prop(name, build)


def pillar(
    name: str, *, radius: float, height: float, mass: float = 1e5, colour: Colour = (0.55, 0.57, 0.60, 1.0),
) -> Prop:  # fmt: skip
    """A round post for games in the plane, with a dome on its `height`.

    It is free, so that each episode can have it elsewhere and recordings show where; without weight and friction, and
    too heavy to be moved: 3 N push it by 1.5 mm in 10 s.
    """

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, (0.0, 0.0, height / 2))
        body.gravcomp = 1
        shape = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [radius, height / 2, 0]}
        body.add_geom(name="pillar", mass=mass, condim=1, priority=1, rgba=colour, contype=2, conaffinity=0, **shape)
        return spec

    return Prop(name, build, free=True)


def goal(
    name: str, *, at: tuple[float, float, float], half: tuple[float, float, float],
    colour: Colour = (0.95, 0.80, 0.20, 0.35),
) -> Prop:  # fmt: skip
    """A box of air that is seen and never touched: what is inside, the game judges by positions."""

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, at)
        body.add_geom(name="goal", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=colour, **_SEEN)
        return spec

    return Prop(name, build)


def _body(name: str, pos: tuple[float, float, float]) -> tuple[mujoco.MjSpec, mujoco.MjsBody]:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    return spec, spec.worldbody.add_body(name="body", pos=pos)
