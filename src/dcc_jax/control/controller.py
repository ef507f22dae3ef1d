"""What the laws of compliance share: the displacement, and the tables of a character.

Letters: nv velocities, nq coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from dcc_jax import quat
from dcc_jax.character import Character
from dcc_jax.control.config import ComplianceConfig
from dcc_jax.control.ranges import JointRanges, Room

Array = jax.Array


@flax.struct.dataclass
class Displacement:
    """u and its velocity, and what they are a share of."""

    u: Array  # [nq], qpos layout: m on the root's translation, quaternions elsewhere
    ud: Array  # [nv], m/s and rad/s, local tangent
    y: Array  # [nv] m and rad, the yield of `admittance`; zero with the other laws
    yd: Array  # [nv] m/s and rad/s


def at_rest(coords: quat.Coordinates) -> Displacement:
    """The displacement that changes nothing, u_0 of Alg. 1."""
    ud, y, yd = jnp.zeros((3, coords.nv))
    return Displacement(u=quat.identity(coords).astype(ud.dtype), ud=ud, y=y, yd=yd)


@dataclass(frozen=True, eq=False)
class Controller:
    """What stays the same from step to step.

    Raises:
        ValueError: `root_dofs` outside [0, nv].
    """

    config: ComplianceConfig
    coords: quat.Coordinates  # the layout of u
    weights: np.ndarray | Array  # [nv] of J's columns, not negative
    dt: float  # physics step, s
    kp: np.ndarray | Array  # [nv] N m/rad, N/m; positive where the weight is
    root_dofs: int = 6  # how many of the first columns are the root's
    ranges: JointRanges | None = None  # None: nothing bounds u

    def __post_init__(self) -> None:
        if not 0 <= self.root_dofs <= self.coords.nv:
            raise ValueError(
                f"root_dofs must be in [0, {self.coords.nv}], got {self.root_dofs}"
            )

    @classmethod
    def of(
        cls,
        config: ComplianceConfig,
        character: Character,
        coords: quat.Coordinates,
        dt: float,
    ) -> Controller:
        """Of a character, with its weights, gains and joint ranges."""
        kp = character.kp.copy()
        kp[:6] = character.scale * config.root_stiffness
        limits = JointRanges(character.lower, character.upper)
        weights = character.column_weight
        return cls(config, coords, weights, dt, kp=kp, ranges=limits)

    @property
    def return_stiffness(self) -> np.ndarray:
        """Spring constants [nv] of the return, 1/s^2."""
        stiffness = np.full(self.coords.nv, self.config.joint_return_stiffness)
        stiffness[: self.root_dofs] = self.config.root_return_stiffness
        return stiffness

    @property
    def driven(self) -> np.ndarray:
        """Whether PD drives each degree of freedom [nv]: all but the root's."""
        return np.arange(self.coords.nv) >= self.root_dofs

    def room(self, q_m: Array) -> Room | None:
        """What a reference q_m [nq] leaves of the joint ranges to u."""
        return None if self.ranges is None else self.ranges.room(self.coords, q_m)
