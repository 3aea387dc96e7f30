"""The pairs of geoms that Warp's broadphase keeps, counted in each world; Warp itself counts only their sum.

The tests are MuJoCo's: bounding spheres, then the face normals of oriented bounding boxes (Gottschalk, Lin and Manocha,
"OBBTree", SIGGRAPH 1996, without the products of edges), and for planes the distance from the plane.
"""

from collections.abc import Callable

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco.mjx.third_party import mujoco_warp


def counter(model: mujoco.MjModel) -> Callable[[Array, Array], Array]:
    """Return `pairs(xpos (ngeom, 3), xmat (ngeom, 3, 3)) -> () int32`, the number of pairs kept in one world."""
    own = mujoco_warp.put_model(model)
    kept = np.array(
        own.nxn_geom_pair_filtered.numpy()
        if hasattr(own.nxn_geom_pair_filtered, "numpy")
        else own.nxn_geom_pair_filtered
    )  # (P, 2)
    reach = model.geom_margin + model.geom_gap
    flat = (model.geom_rbound[kept] == 0).any(1)
    ground, solid = kept[flat], kept[~flat]
    ground = np.where((model.geom_rbound[ground[:, 0]] == 0)[:, None], ground, ground[:, ::-1])  # the plane first
    centre, size = model.geom_aabb[:, :3], model.geom_aabb[:, 3:]

    def pairs(xpos: Array, xmat: Array) -> Array:
        plane, other = ground.T
        height = jnp.einsum("pk,pk->p", xpos[other] - xpos[plane], xmat[plane, :, 2])
        low = height <= model.geom_rbound[other] + reach[plane] + reach[other]
        a, b = solid.T
        bound, apart = reach[a] + reach[b], xpos[b] - xpos[a]
        near = (apart**2).sum(1) <= (model.geom_rbound[a] + model.geom_rbound[b] + bound) ** 2
        middle = xpos + jnp.einsum("gij,gj->gi", xmat, centre)
        between, extents = middle[b] - middle[a], ((a, size[a]), (b, size[b]))
        for faces in (xmat[a], xmat[b]):  # (P, 3, 3), a normal in each column
            gap = jnp.abs(jnp.einsum("pi,pij->pj", between, faces))
            radius = sum(
                jnp.einsum("pk,pkj->pj", half, jnp.abs(jnp.einsum("pik,pij->pkj", xmat[of], faces)))
                for of, half in extents
            )
            near &= (radius + bound[:, None] >= gap).all(1)
        return low.sum(dtype=jnp.int32) + near.sum(dtype=jnp.int32)

    return pairs
