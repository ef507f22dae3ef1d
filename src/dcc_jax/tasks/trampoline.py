"""The trampoline (Sec. 5.3): a rigid plate on springs that bounces the character.

The fabric is a rigid plate with a spring-damper at each of its four corners, that is,
one in height, roll and pitch. Every three seconds an upward force on the plate throws
the character up. The contact forces of the feet are fed to the compliance for one
second after each landing: absorb, then recover. A landing after all but a quarter of a
turn in the air counts as a flip, once the character has stood it for that second.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dcc_jax import physics
from dcc_jax.character import CONTROL_DT, FEET, GRAVITY, add_contact, sole_names
from dcc_jax.env.task import Event, Forces, Task, place_character, resultant
from dcc_jax.motion.reference import RefState

Array = jax.Array

PITCH = 4  # of the character's qvel: the pelvis turns forward about its left
FLIP = 1.5 * np.pi  # rad
HALF_SIZE, HALF_THICKNESS = 1.5, 0.05  # m


@flax.struct.dataclass
class TrampolineState:
    """The bounce schedule and the landing that opens the gate."""

    next_bounce: Array  # [] s until the plate kicks; negative while it does
    airborne: Array  # [] s since a foot last touched the plate
    landed: Array  # [] s since the last landing
    turned: Array  # [] rad, backwards, since it last stood
    flips: Array  # [] how many it has stood


@dataclass(frozen=True)
class Trampoline(Task):
    """Stand on the plate, fly, land, absorb."""

    name: ClassVar[str] = "trampoline"
    clips: ClassVar[tuple[str, ...]] = ("stand", "balance", "jump", "jump_series")
    state_size: ClassVar[int] = 8
    event: ClassVar[Event | None] = Event("bounce", "next_bounce")
    clock: ClassVar[str | None] = "since_bounce"
    pd_yields: ClassVar[bool] = False
    config_overrides: ClassVar[Mapping[str, Any]] = {
        "ppo.sigma_degrees": 3.0,
        "env.velocity_time": 0.1,
        "env.turn_arm": 0.1,
        "disc.feature_floor": 0.03,
    }
    """docs/skills/trampoline.md compares them."""

    interval: float = 3.0
    """Time between two bounces, s (Sec. 5.3)."""
    plate_mass: float = 20.0
    """Mass of the plate, kg."""
    stiffness: float = 8000.0
    """Stiffness of the four corners together, N/m: a standing character sinks 8 cm."""
    damping: float = 500.0
    """Damping of the four together, N s/m: a ratio of 0.3 with the character on it."""
    kick: float = 2400.0
    """Upward force of a kick on the plate, N."""
    kick_time: float = 0.2
    """Duration of a kick, s."""
    absorb_time: float = 1.0
    """Time after a landing in which contact forces count, s (Sec. 5.3)."""
    flight_time: float = 0.08
    """Time without contact that makes the next touch a landing, s."""

    def quiet(self) -> Trampoline:
        """Nobody bounces the plate."""
        return dataclasses.replace(self, interval=1e9)

    @property
    def has_floor(self) -> bool:
        """The plate is the ground."""
        return False

    def extend(self, spec: mujoco.MjSpec) -> None:
        """The plate, its springs, and contacts with the soles."""
        plate = spec.worldbody.add_body(name="plate", pos=[0, 0, -HALF_THICKNESS])
        corner = HALF_SIZE**2
        for name, kind, axis, scale in (
            ("plate_z", mujoco.mjtJoint.mjJNT_SLIDE, [0, 0, 1], 1.0),
            ("plate_roll", mujoco.mjtJoint.mjJNT_HINGE, [1, 0, 0], corner),
            ("plate_pitch", mujoco.mjtJoint.mjJNT_HINGE, [0, 1, 0], corner),
        ):
            joint = plate.add_joint(name=name, type=kind, axis=axis)
            joint.stiffness = np.array([scale * self.stiffness, 0, 0])
            joint.damping = np.array([scale * self.damping, 0, 0])
        plate.add_geom(
            name="plate",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[HALF_SIZE, HALF_SIZE, HALF_THICKNESS],
            mass=self.plate_mass,
            rgba=[0.3, 0.45, 0.75, 1.0],
            contype=0,
            conaffinity=0,
        )
        for sole in sole_names(spec):
            add_contact(spec, "plate", sole)

    def reset(
        self, key: Array, scene: physics.Scene, reference: RefState
    ) -> tuple[TrampolineState, Array, Array]:
        """The plate at rest; the first bounce after a random share of the interval."""
        qpos, qvel = place_character(scene, reference)
        state = TrampolineState(
            next_bounce=self.interval * jax.random.uniform(key),
            airborne=jnp.zeros(()),
            landed=jnp.full((), self.absorb_time),
            turned=jnp.zeros(()),
            flips=jnp.zeros(()),
        )
        return state, qpos, qvel

    def control_step(
        self,
        key: Array,
        scene: physics.Scene,
        state: TrampolineState,
        body: physics.State,
    ) -> tuple[TrampolineState, physics.State]:
        """Counts down to the bounce, and the turns until it stands again.

        Who stands has turned by whole turns, but for the lean of the take-off.
        """
        over = state.next_bounce < -self.kick_time
        left = jnp.where(over, state.next_bounce + self.interval, state.next_bounce)
        pitch_rate = scene.character_qvel(body.qvel)[PITCH]
        stands = (state.airborne == 0.0) & (state.landed >= self.absorb_time)
        flipped = stands & (jnp.abs(state.turned) > FLIP)
        return dataclasses.replace(
            state,
            next_bounce=left - CONTROL_DT,
            turned=jnp.where(stands, 0.0, state.turned - CONTROL_DT * pitch_rate),
            flips=state.flips + flipped,
        ), body

    def applied(
        self,
        scene: physics.Scene,
        state: TrampolineState,
        kin: physics.Kinematics,
        time: Array,
    ) -> Array:
        """The weights that the springs' rest position carries, and the kick."""
        weight = GRAVITY * float(scene.model.body_mass.sum())
        kicking = state.next_bounce <= 0.0
        _, height = scene.address("plate_z")
        force = weight + jnp.where(kicking, self.kick, 0.0)
        return jnp.zeros(scene.model.nv).at[height].set(force)

    def forces(
        self,
        scene: physics.Scene,
        state: TrampolineState,
        kin: physics.Kinematics,
        solution: physics.Solution,
        action: Array,
    ) -> tuple[TrampolineState, Forces]:
        """One resultant a foot, F = 2; heard for a while after each landing."""
        feet = [scene.body(name) for name in FEET]
        sums = [resultant(solution, scene.contacts([foot])) for foot in feet]
        force = jnp.stack([f for f, _ in sums])
        touching = jnp.any(force != 0.0)
        landing = touching & (state.airborne > self.flight_time)
        state = dataclasses.replace(
            state,
            airborne=jnp.where(touching, 0.0, state.airborne + scene.timestep),
            landed=jnp.where(landing, 0.0, state.landed + scene.timestep),
        )
        return state, Forces(
            force_w=force,
            point_w=jnp.stack([p for _, p in sums]),
            body=jnp.asarray(feet),
            gate=state.landed < self.absorb_time,
        )

    def observe(
        self, scene: physics.Scene, state: TrampolineState, body: physics.State
    ) -> Array:
        """Plate height, tilt and their rates [6]; time to and since events [2]."""
        adr, dof = scene.address("plate_z")
        return jnp.concatenate(
            [
                body.qpos[adr : adr + 3],
                body.qvel[dof : dof + 3],
                jnp.stack([state.next_bounce, jnp.minimum(state.landed, 1.0)]),
            ]
        )

    def terminated(
        self, scene: physics.Scene, state: TrampolineState, body: physics.State
    ) -> Array:
        """Off the plate."""
        root = scene.character_qpos(body.qpos)[:2]
        return jnp.any(jnp.abs(root) > HALF_SIZE - 0.1)

    def ground_height(
        self, scene: physics.Scene, state: TrampolineState, body: physics.State
    ) -> Array:
        """Height of the plate's middle."""
        return body.qpos[scene.address("plate_z")[0]]

    def evaluate(
        self, scene: physics.Scene, state: TrampolineState, body: physics.State
    ) -> dict[str, Array]:
        """`since_bounce` s since the last kick began, `plate_height` m, `in_flight`,
        `turned` rad backwards since it last stood, `flips` that it landed and stood."""
        to_come = state.next_bounce > 0.0
        return {
            "since_bounce": jnp.where(to_come, self.interval, 0.0) - state.next_bounce,
            "plate_height": self.ground_height(scene, state, body),
            "in_flight": state.airborne > self.flight_time,
            "turned": state.turned,
            "flips": state.flips,
        }
