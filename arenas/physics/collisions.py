"""Pairs of geoms that can meet in a model, and pairs that an engine cannot collide.

The table was derived from the source of mujoco and mujoco-mjx 3.17.0 and tested there;
`tests/arenas/physics/test_collisions.py` tests it again on the installed versions:

| pair                                       | `c`               | `jax`  | `warp`                                 |
|--------------------------------------------|-------------------|--------|----------------------------------------|
| ellipsoid or cylinder on box or mesh       | yes               | raises | yes                                    |
| ellipsoid or cylinder on a height field    | yes               | raises | yes                                    |
| SDF on a height field                      | no contact, warns | raises | wrong distance, prints                 |
| SDF on a mesh                              | yes               | raises | right at the world's origin alone: 1 m |
|                                            |                   |        | from it the two are drawn together     |
| SDF on anything else                       | yes               | raises | yes                                    |
| mesh or height field with a contact margin | yes               | raises | yes                                    |

All other pairs have a function on each of the three engines, though not the same one: two boxes make up to 8 contacts
in C and on Warp and up to 4 in MJX, whose cylinders and ellipsoids collide by a few steps of gradient descent.
"""

from collections.abc import Iterator
from itertools import combinations_with_replacement

import mujoco
import numpy as np

from arenas.errors import EngineError

_GEOM = mujoco.mjtGeom
HFIELD, ELLIPSOID, CYLINDER = map(int, (_GEOM.mjGEOM_HFIELD, _GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_CYLINDER))
BOX, MESH, SDF = map(int, (_GEOM.mjGEOM_BOX, _GEOM.mjGEOM_MESH, _GEOM.mjGEOM_SDF))
TYPES = range(SDF + 1)  # those that collide; later types are only drawn

# Pairs of geom types, the smaller first, for which an engine has no function.
_NO_ENGINE = frozenset({(HFIELD, SDF)})
UNSUPPORTED: dict[str, frozenset[tuple[int, int]]] = {
    "c": _NO_ENGINE,
    "warp": _NO_ENGINE | {(MESH, SDF)},
    "jax": frozenset(
        (a, b)
        for a, b in combinations_with_replacement(TYPES, 2)
        if b == SDF or ({a, b} & {ELLIPSOID, CYLINDER} and {a, b} & {HFIELD, BOX, MESH})
    ),
}


def colliding_pairs(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Yield the ids of geoms that can meet, the smaller type first.

    This follows MuJoCo: geoms meet by `<pair>`, or if their bits agree, their bodies are neither welded together nor
    parent and child (except for the world) nor excluded, and at least one of them can move.
    """
    m = model
    one, two = np.triu_indices(m.ngeom, k=1)
    agree = (m.geom_contype[one] & m.geom_conaffinity[two]) | (m.geom_contype[two] & m.geom_conaffinity[one])
    bodies = m.geom_bodyid[one], m.geom_bodyid[two]
    weld = [m.body_weldid[body] for body in bodies]
    above = [m.body_weldid[m.body_parentid[body]] for body in weld]
    related = (weld[0] == above[1]) | (weld[1] == above[0])
    if m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        related[:] = False
    related &= (weld[0] != 0) & (weld[1] != 0)
    fixed = (m.body_dofnum[weld[0]] == 0) & (m.body_dofnum[weld[1]] == 0)
    excluded = np.isin((bodies[0] << 16) + bodies[1], m.exclude_signature)
    can = (agree != 0) & (weld[0] != weld[1]) & ~related & ~fixed & ~excluded
    found = {(int(a), int(b)) for a, b in zip(one[can], two[can], strict=True)}
    found |= {(int(min(p)), int(max(p))) for p in zip(m.pair_geom1, m.pair_geom2, strict=True)}
    for a, b in sorted(found):
        yield (a, b) if m.geom_type[a] <= m.geom_type[b] else (b, a)


def check_collisions(model: mujoco.MjModel, engine: str) -> None:
    """Raise EngineError, one line, if geoms can meet in this model that the engine cannot collide."""
    if model.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        return
    pairs = list(colliding_pairs(model))
    bad = {name: [pair for pair in pairs if _unsupported(model, name, pair)] for name in UNSUPPORTED}
    if not bad[engine]:
        return
    a, b = bad[engine][0]
    why = "" if _types(model, (a, b)) in UNSUPPORTED[engine] else " with a margin"
    more = f" (nor {len(bad[engine]) - 1} more such pairs)" if len(bad[engine]) > 1 else ""
    able = [name for name in UNSUPPORTED if not bad[name]]
    instead = f"use engine {' or '.join(able)}" if able else "no engine can collide all of these"
    change = "take the margin away" if why else "make one of them a sphere or a capsule"
    raise EngineError(
        f"engine {engine} cannot collide {_describe_geom(model, a)} with {_describe_geom(model, b)}{why}{more}:"
        f" {instead}; or {change},"
        " or keep them apart by contype and conaffinity"
    )


def _unsupported(model: mujoco.MjModel, engine: str, pair: tuple[int, int]) -> bool:
    types = _types(model, pair)
    return types in UNSUPPORTED[engine] or (
        engine == "jax" and bool({*types} & {HFIELD, MESH}) and _margin(model, pair) > 0
    )


def _types(model: mujoco.MjModel, pair: tuple[int, int]) -> tuple[int, int]:
    a, b = (int(model.geom_type[geom]) for geom in pair)
    return a, b


def _margin(model: mujoco.MjModel, pair: tuple[int, int]) -> float:
    """Return the distance in metres at which two geoms begin to make contacts."""
    declared = {frozenset(p): i for i, p in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))}
    if frozenset(pair) in declared:
        return float(model.pair_margin[declared[frozenset(pair)]])
    return float(model.geom_margin[list(pair)].sum())


def _describe_geom(model: mujoco.MjModel, geom: int) -> str:
    """Name a geom for a person, e.g. `red/0/chassis (box)`."""
    kind = _GEOM(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
    body = int(model.geom_bodyid[geom])
    return f"{model.geom(geom).name or f'geom {geom} of body {model.body(body).name or body}'} ({kind})"
