# SPDX-License-Identifier: Apache-2.0

"""Move coarse hypotheses onto the data: projective point-to-plane alignment of surface samples, in the three degrees of
freedom in which an object can slide and turn on the table."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes3d_ros.geometry.robust import geman_mcclure
from bayes3d_ros.likelihood.scored_image import ScoredImage
from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Placement, T_camera_object, Table
from bayes3d_ros.parsing.coarse_search import UnexplainedReturns
from bayes3d_ros.parsing.surface_samples import in_camera, normal_motion, pixels_of
from bayes3d_ros.parsing.tuning import SEARCH


def align(
    placement: Placement, returns: UnexplainedReturns, image: ScoredImage, library: LibraryArrays, table: Table
) -> tuple[Placement, Float[Array, "N 3 3"]]:
    """Aligned hypotheses, and their information matrices about (x, y, yaw): J^T J summed over samples, to be
    divided by the variance of a residual in metres^2."""

    def step(placement: Placement, tolerance: Float[Array, ""]):
        T = T_camera_object(placement, library, table)
        surface = in_camera(library.surface_point[placement.type], library.surface_normal[placement.type], T)
        p, n = surface
        z, u, v, seen = pixels_of(p, image)
        observed = returns.depth[v, u]
        q = observed[..., None] * jnp.stack([image.ray_x[u], image.ray_y[v], jnp.ones_like(observed)], -1)
        residual = (n * (q - p)).sum(-1)
        gap = jnp.abs(observed - z)
        # A surface that faces away returned nothing, however near: walls are thinner than the tolerance.
        facing = surface.cosine() > 0.15
        weight = jnp.where(seen & (observed > 0) & (gap < 3 * tolerance) & facing, 1.0, 0.0)
        weight = weight * returns.unexplained[v, u] / geman_mcclure(residual, tolerance)
        J = normal_motion(surface, placement, table)
        information = jnp.einsum("np,npa,npb->nab", weight, J, J)
        # A weak pull to the hypothesis' own pose (2 cm, 0.3 rad), for directions that the data leave open.
        damped = information + jnp.diag(tolerance**2 / jnp.array([0.02, 0.02, 0.3]) ** 2)
        move = jnp.linalg.solve(damped, jnp.einsum("np,npa,np->na", weight, J, residual)[..., None])[..., 0]
        move = jnp.clip(move, -jnp.array([0.01, 0.01, 0.15]), jnp.array([0.01, 0.01, 0.15]))
        moved = placement._replace(
            x=placement.x + move[:, 0], y=placement.y + move[:, 1], yaw=placement.yaw + move[:, 2]
        )
        return moved, information

    first, last = SEARCH.align_first_tolerance, SEARCH.align_last_tolerance
    tolerances = first * (last / first) ** jnp.linspace(0, 1, SEARCH.align_rounds)
    placement, information = jax.lax.scan(step, placement, tolerances)
    return placement, information[-1]
