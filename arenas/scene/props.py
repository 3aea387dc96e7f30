"""Objects of a game that belong to no team: balls, blocks, walls, goals. They are values, placed by `scene.build`.

Collision bits, as used by all robots here: bit 1 is the ground, bit 2 are bodies. The ground has (contype 1,
conaffinity 0), an object that stands on it and can be pushed (2, 3), a wheel that only rolls on the ground (0, 1).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco

Colour = tuple[float, float, float, float]
_MOVABLE = {"contype": 2, "conaffinity": 3}  # touches ground, robots and other movable objects
_FIXED = {"contype": 3, "conaffinity": 2}  # touches everything that moves
_VISUAL = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}  # drawn and never touched

# A bounce takes pi / BOUNCE = 31 ms, six physics steps of 5 ms. With a stiffer spring the restitution is unpredictable
# (at 200 rad/s 0.55 to 0.86 instead of 0.6); with a softer one the ball sinks in (here 3 cm at 3 m/s).
BOUNCE = 100.0  # rad/s
_ELASTIC = (0.99, 0.99, 0.001, 0.5, 2.0)  # solimp: the spring produces all of the contact's force


@dataclass(frozen=True)
class Prop:
    """A named object: its body, and whether it can move. Its geoms in the model are called `name/...`.

    `build` returns a spec with one body under the world, at the prop's position in the rest pose. `scene.build` adds a
    free joint to a free prop and records its indices in qpos and qvel.
    """

    name: str
    build: Callable[[], mujoco.MjSpec]
    free: bool = False


def ball(
    name: str = "ball", *, radius: float, mass: float, colour: Colour = (0.95, 0.95, 0.92, 1.0),
    friction: tuple[float, float, float] = (0.7, 0.005, 0.0001), restitution: float | None = None, hollow: bool = False,
) -> Prop:  # fmt: skip
    """Make a ball, in metres and kilograms. `friction` is sliding, torsional, rolling, the last two in metres.

    With a `restitution` above 0 it rebounds with that share of its speed (see `bouncing`); without one it hardly
    bounces, as is usual for MuJoCo's contacts. A `hollow` ball has its mass in its skin.
    """
    inertia = mujoco.mjtGeomInertia
    bounce = {} if restitution is None else {"solref": bouncing(restitution), "solimp": _ELASTIC}

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, (0.0, 0.0, radius))
        body.add_geom(
            name="ball", size=[radius, 0, 0], mass=mass, condim=6, priority=2, friction=friction, rgba=colour,
            typeinertia=inertia.mjINERTIA_SHELL if hollow else inertia.mjINERTIA_VOLUME, **bounce, **_MOVABLE,
        )  # fmt: skip
        return spec

    return Prop(name, build, free=True)


def bouncing(restitution: float) -> tuple[float, float]:
    """Return MuJoCo's `solref` for a coefficient of restitution in (0, 1]; MuJoCo has no such parameter.

    In its negative form solref is the stiffness and damping, per unit of mass, of the spring that models a contact. A
    spring of rate w and damping ratio z returns the share exp(-pi z / sqrt(1 - z^2)) of the impact speed. The share of
    a single bounce differs by some hundredths, because physics steps divide the contact at varying moments.
    """
    loss = -math.log(restitution)
    return -(BOUNCE**2), -2.0 * BOUNCE * loss / math.hypot(math.pi, loss)


def block(
    name: str = "block", *, half: tuple[float, float, float], mass: float, at: tuple[float, float] = (0.0, 0.0),
    colour: Colour = (0.72, 0.52, 0.30, 1.0), friction: tuple[float, float, float] = (0.5, 0.005, 0.0001),
) -> Prop:  # fmt: skip
    """Make a box that can be pushed; `half` are its half sizes in metres, `at` is its place on the ground."""

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, (*at, half[2]))
        body.add_geom(
            name="block",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            mass=mass,
            friction=friction,
            rgba=colour,
            **_MOVABLE,
        )
        return spec

    return Prop(name, build, free=True)


def wall(
    name: str, *, at: tuple[float, float, float], half: tuple[float, float, float],
    colour: Colour = (0.55, 0.57, 0.60, 1.0),
) -> Prop:  # fmt: skip
    """Make a fixed box, with centre `at` and half sizes in metres."""

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, at)
        body.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=colour, **_FIXED)
        return spec

    return Prop(name, build)


def square_of_walls(side: float, height: float, thick: float = 0.1) -> list[Prop]:
    """Make four walls round a square field, which meet at its corners; `thick` is half a wall, all in metres."""
    off, z = side / 2 + thick, height / 2
    along, across = (off + thick, thick, z), (thick, off + thick, z)
    return [
        wall("south", at=(0.0, -off, z), half=along), wall("north", at=(0.0, off, z), half=along),
        wall("west", at=(-off, 0.0, z), half=across), wall("east", at=(off, 0.0, z), half=across),
    ]  # fmt: skip


def pillar(
    name: str, *, radius: float, height: float, mass: float = 1e5, colour: Colour = (0.55, 0.57, 0.60, 1.0),
) -> Prop:  # fmt: skip
    """Make a round post for games in the plane, with a dome on its `height`.

    It is free, so that each episode can place it anew and recordings show its place. It has no weight and no friction,
    and is too heavy to be moved: 3 N push it by 1.5 mm in 10 s.
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
    """Make a box that is drawn and never touched: the game judges by positions what is inside."""

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, at)
        body.add_geom(name="goal", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=colour, **_VISUAL)
        return spec

    return Prop(name, build)


def frame(
    name: str, *, at: tuple[float, float, float], heading: float, side: float, thick: float = 0.03,
    colour: Colour = (0.95, 0.45, 0.10, 1.0),
) -> Prop:  # fmt: skip
    """Make an upright square frame that is drawn and never touched: a gate, of which the game judges who passes it.

    `at` is the centre of its opening, `heading` in radians the direction in which its opening is passed, `side` that of
    the opening and `thick` half of its beams, in metres.
    """

    def build() -> mujoco.MjSpec:
        spec, body = _body(name, at)
        body.quat = [math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)]
        off, box = side / 2 + thick, mujoco.mjtGeom.mjGEOM_BOX
        for beam, pos, size in (
            ("left", [0, off, 0], [thick, thick, off + thick]), ("right", [0, -off, 0], [thick, thick, off + thick]),
            ("top", [0, 0, off], [thick, off - thick, thick]), ("bottom", [0, 0, -off], [thick, off - thick, thick]),
        ):  # fmt: skip
            body.add_geom(name=beam, type=box, pos=pos, size=size, rgba=colour, **_VISUAL)
        return spec

    return Prop(name, build)


def _body(name: str, pos: tuple[float, float, float]) -> tuple[mujoco.MjSpec, mujoco.MjsBody]:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    return spec, spec.worldbody.add_body(name="body", pos=pos)
