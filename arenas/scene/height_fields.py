"""Height fields: uneven ground, of which a scene may have several and each world has at most one in place.

A height field is a body of its own, fixed to the world. Where it is not in place, `body_pos` puts it DEEP below the
ground. C and MJX read that field of the model in every world and step, while what a geom shows (`geom_dataid`) is fixed
in MJX when a step is compiled. Warp places bodies that are fixed to the world once for all, so it is refused.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.errors import EngineError
from arenas.scene.props import Prop

CELL = 0.25  # m between two points of a field
BEGIN, BEYOND, HALF_WIDTH = 1.0, 2.0, 3.0  # m: a field is from BEGIN ahead of the start to BEYOND the goal
SINK = 0.01  # m by which it lies in the ground, which alone is touched where the field is flat
DEEP = 100.0  # m
COLOUR = (0.42, 0.40, 0.36, 1.0)


def bumps(ahead: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return heights, drawn once for all for each point alone."""
    return np.random.default_rng(0).uniform(size=shape)


def terraces(ahead: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return four steps up to the middle, and four down, across the way."""
    return np.broadcast_to(np.ceil(8 * np.minimum(ahead, 1 - ahead)) / 4, shape)


def waves(ahead: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return waves of 2 m across the way."""
    metres = CELL * np.arange(shape[1])
    return np.broadcast_to(np.sin(np.pi * metres / 2) ** 2, shape)


# (share of the way (columns,), (rows, columns)) -> heights from 0 to 1
SHAPES: Mapping[str, Callable[[np.ndarray, tuple[int, int]], np.ndarray]] = {
    "bumps": bumps, "terraces": terraces, "waves": waves,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class HeightField:
    """A field along the world's x, from BEGIN to BEYOND a distance, symmetric about the x axis; its border is flat."""

    name: str
    heights: np.ndarray  # (rows along y, columns along x) m, from 0

    @classmethod
    def of(cls, name: str, height: float, distance: float) -> "HeightField":
        """Make the field of a name in SHAPES with its highest points at `height`, for a way of this distance (m)."""
        rows, columns = 2 * round(HALF_WIDTH / CELL) + 1, round((distance + BEYOND - BEGIN) / CELL) + 1
        shape = np.array(SHAPES[name](np.linspace(0.0, 1.0, columns), (rows, columns)))
        shape[[0, -1]] = shape[:, [0, -1]] = 0.0
        return cls(name, height * shape / shape.max())

    @property
    def middle(self) -> float:
        """Return the x of its middle, m."""
        return BEGIN + CELL * (self.heights.shape[1] - 1) / 2

    def prop(self) -> Prop:
        """Return the field as a prop of a scene, deep below the ground."""
        rows, columns = self.heights.shape
        high = float(self.heights.max())
        half = CELL * (columns - 1) / 2, CELL * (rows - 1) / 2

        def build() -> mujoco.MjSpec:
            spec = mujoco.MjSpec()
            spec.compiler.degree = False
            spec.add_hfield(
                name="field", nrow=rows, ncol=columns, size=[*half, high, 0.05], userdata=self.heights.ravel() / high
            )
            body = spec.worldbody.add_body(name="body", pos=[self.middle, 0.0, -DEEP])
            body.add_geom(
                name="field", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field", contype=1, conaffinity=0,
                friction=[0.3, 0.005, 0.0001], rgba=COLOUR,
            )  # fmt: skip
            return spec

        return Prop(self.name, build)

    def height(self, at: Array) -> Array:
        """Return the height () of its surface above the ground at x and y (2,), m; 0 beside it."""
        rows, columns = self.heights.shape
        place = jnp.stack([(at[1] + CELL * (rows - 1) / 2) / CELL, (at[0] - BEGIN) / CELL])
        inside = jnp.all((place >= 0) & (place <= jnp.array([rows - 1, columns - 1])))
        low = jnp.clip(jnp.floor(place).astype(int), 0, jnp.array([rows - 2, columns - 2]))
        share, table = place - low, jnp.asarray(self.heights, jnp.float32)
        along = [table[low[0] + i, low[1]] * (1 - share[1]) + table[low[0] + i, low[1] + 1] * share[1] for i in (0, 1)]
        return jnp.where(inside, jnp.maximum(along[0] * (1 - share[0]) + along[1] * share[0] - SINK, 0.0), 0.0)


class Terrain:
    """The choice among a scene's height fields: number 0 is the flat ground, then the fields in their order."""

    def __init__(self, model: mujoco.MjModel, fields: Sequence[HeightField], engine: str):
        """Find the fields in a compiled scene that has their props.

        Raises EngineError, one line, for an engine that cannot choose among them.
        """
        if fields and engine == "warp":
            raise EngineError("engine warp cannot choose among height fields in each world: take engine c, or jax")
        self.fields = tuple(fields)
        self._bodies = np.array([model.body(f"{field.name}/body").id for field in self.fields], int)

    def placed(self, body_pos: Array, number: Array) -> Array:
        """Return the places of all bodies (nbody, 3) with field `number` () in place."""
        chosen = jnp.arange(1, len(self.fields) + 1) == number
        return body_pos.at[self._bodies, 2].set(jnp.where(chosen, -SINK, -DEEP))

    def height(self, body_pos: Array, at: Array) -> Array:
        """Return the height () above the ground, at x and y (2,), of the field that is in place by `body_pos`."""
        there = body_pos[self._bodies, 2] > -DEEP / 2
        return jnp.sum(jnp.where(there, jnp.stack([field.height(at) for field in self.fields]), 0.0))
