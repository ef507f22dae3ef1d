"""The physics of one scene: the only package that calls MJX.

`scene` compiles a model, `step` moves it; both are used as `physics.make_scene(...)`,
`physics.solve(...)`. The contact solver and its sparsity are this package's own.
"""

from dcc_jax.physics.scene import Contacts, Scene, make_scene
from dcc_jax.physics.step import (
    Kinematics,
    Solution,
    State,
    World,
    default_world,
    generalized_force,
    initial_state,
    integrate,
    kinematics,
    mass_matrix,
    mass_solve,
    point_jacobian,
    solve,
)

__all__ = [
    "Contacts",
    "Kinematics",
    "Scene",
    "Solution",
    "State",
    "World",
    "default_world",
    "generalized_force",
    "initial_state",
    "integrate",
    "kinematics",
    "make_scene",
    "mass_matrix",
    "mass_solve",
    "point_jacobian",
    "solve",
]
