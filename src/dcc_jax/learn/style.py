"""How close a policy's motion is to its clips, without the discriminator.

The discriminator moves with the policy, so its score does not say whether training has
converged. Two distances to the clips do: of each pair (s, s') of the policy to the
nearest pair of the clips, and between the two sets of pairs as Gaussians (the Frechet
distance of Heusel et al. 2017). The first falls when every pose is a plausible one, the
second only when the clips are also covered in full.

Both are in metres: the coordinates of a pair (`Environment.style_coordinates`) are such
that |x - y| is the root mean square distance over the bodies.

Letters: N pairs of the policy, M pairs of the clips, E coordinates of a pair.
"""

from __future__ import annotations

from typing import Protocol

import flax.struct
import jax
import jax.numpy as jnp

from dcc_jax.learn.rollout import Running

Array = jax.Array

CLIP_PAIRS = (
    2048  # M; other pairs of the same clips are then 4 to 5 mm from the nearest
)
_SEED = 20220707  # of the pairs, the same in every run, so that runs can be compared


class Posed(Protocol):
    """The part of an environment that is read here."""

    def expert_pairs(self, key: Array, spans: Array) -> tuple[Array, Array, Array]: ...
    def style_coordinates(self, s: Array, s_next: Array) -> Array: ...


@flax.struct.dataclass
class Reference:
    """What the clips look like."""

    pairs: Array  # [M, E] m
    mean: Array  # [E]
    root: Array  # [E, E] symmetric square root of the covariance


def make_reference(environment: Posed, count: int = CLIP_PAIRS) -> Reference:
    """M pairs of an environment's clips and their Gaussian; equal for equal clips."""
    s, s_next, _ = environment.expert_pairs(jax.random.key(_SEED), _next(count))
    pairs = environment.style_coordinates(s, s_next)
    mean, covariance = _moments(pairs, jnp.ones(count))
    values, vectors = jnp.linalg.eigh(covariance)
    root = (vectors * jnp.sqrt(jnp.maximum(values, 0.0))) @ vectors.T
    return Reference(pairs=pairs, mean=mean, root=root)


def nearest(reference: Reference, points: Array) -> Array:
    """Distance [N] in m of each pair [N, E] to the nearest pair of the clips."""
    centred, clips = points - reference.mean, reference.pairs - reference.mean
    square = (
        jnp.sum(centred**2, axis=1)[:, None]
        + jnp.sum(clips**2, axis=1)
        - 2.0 * centred @ clips.T
    )
    return jnp.sqrt(jnp.maximum(jnp.min(square, axis=1), 0.0))


def frechet(reference: Reference, points: Array, weight: Array) -> Array:
    """Frechet distance [] in m between the Gaussians of policy and clips.

    |m1 - m2|^2 + tr(C1 + C2 - 2 (C1^1/2 C2 C1^1/2)^1/2), and the root of it (Dowson and
    Landau 1982). It needs no inverse, so few or flat sets of pairs are no trouble; with
    few it is too large, and only values of equal N compare.

    Args:
        reference: of the clips.
        points: pairs [N, E].
        weight: [N], zero for pairs that do not count.
    """
    mean, covariance = _moments(points, weight)
    values = jnp.linalg.eigvalsh(reference.root @ covariance @ reference.root)
    cross = jnp.sum(jnp.sqrt(jnp.maximum(values, 0.0)))
    spread = jnp.sum(reference.root**2) + jnp.trace(covariance) - 2.0 * cross
    return jnp.sqrt(jnp.sum((mean - reference.mean) ** 2) + jnp.maximum(spread, 0.0))


def of_running(environment: Posed, running: Running) -> dict[str, Array]:
    """`measure` of the pairs that the environments of a rollout hold now, [B].

    Those that were just reset hold none. It depends on the arguments alone, so that a
    resumed run logs what an uninterrupted one does.
    """
    env = running.env
    points = environment.style_coordinates(env.previous_features, env.features)
    weight = (running.steps > 0).astype(points.dtype)
    reference = make_reference(environment)
    return measure(reference, points, weight) | {
        "style/floor": floor(environment, reference)
    }


def floor(environment: Posed, reference: Reference, count: int = 512) -> Array:
    """`style/nearest` [] in m of other pairs of the clips: nothing comes nearer."""
    s, s_next, _ = environment.expert_pairs(jax.random.key(_SEED + 1), _next(count))
    return jnp.mean(nearest(reference, environment.style_coordinates(s, s_next)))


def measure(reference: Reference, points: Array, weight: Array) -> dict[str, Array]:
    """`style/nearest` and `style/frechet` [] in m; arguments as of `frechet`."""
    distance = jnp.sum(weight * nearest(reference, points)) / jnp.sum(weight)
    return {
        "style/nearest": distance,
        "style/frechet": frechet(reference, points, weight),
    }


def _next(count: int) -> Array:
    """Pairs of consecutive control steps."""
    return jnp.ones(count, jnp.int32)


def _moments(points: Array, weight: Array) -> tuple[Array, Array]:
    share = weight / jnp.sum(weight)
    mean = share @ points
    centred = (points - mean) * jnp.sqrt(share)[:, None]
    return mean, centred.T @ centred
