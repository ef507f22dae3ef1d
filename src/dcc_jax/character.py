"""The character of Sec. 5.1: static tables by name, mass variants, scene composition.

`assets/character.xml` holds bodies, joints and shapes; this module holds what a
controller needs beyond them (gains, torque limits, joint ranges, weights of the
Jacobian columns). Both list the joints in the same order, which is MuJoCo's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np

CONTROL_RATE = 30  # Hz, Sec. 5.1
CONTROL_DT = 1.0 / CONTROL_RATE  # s
GRAVITY = 9.81  # m/s^2, MuJoCo's default
STANDARD_MASS = 65.0  # kg, Sec. 5.1
MASS_RANGE = (20.0, 150.0)  # kg; the paper uses 36, 65 and 85
FEET = ("left_foot", "right_foot")


@dataclass(frozen=True)
class Joint:
    """One ball joint: gains and limits of the 65 kg character.

    kp lies in the paper's 300 to 500 N m/rad (Sec. 5.1). `lower` and `upper` bound the
    rotation vector of the joint in rad, component by component, from the T-pose.
    """

    name: str
    kp: float  # N m/rad
    torque_limit: float  # N m
    column_weight: float  # weight of its columns of J (Sec. 5.1: hips and shoulders)
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]


def _mirrored(joint: Joint) -> Joint:
    """The right-hand twin of a left joint: x and z rotations change sign."""
    (lx, ly, lz), (ux, uy, uz) = joint.lower, joint.upper
    return Joint(
        joint.name.replace("left_", "right_"),
        joint.kp,
        joint.torque_limit,
        joint.column_weight,
        (-ux, ly, -uz),
        (-lx, uy, -lz),
    )


_SPINE = Joint("spine", 500.0, 300.0, 1.0, (-0.7, -0.6, -0.8), (0.7, 1.4, 0.8))
_NECK = Joint("neck", 300.0, 100.0, 1.0, (-0.7, -1.0, -1.3), (0.7, 1.0, 1.3))
_SHOULDER = Joint(
    "left_shoulder", 400.0, 150.0, 2.0, (-1.8, -1.8, -2.3), (1.7, 1.8, 1.6)
)
_ELBOW = Joint("left_elbow", 300.0, 100.0, 1.0, (-1.6, -1.7, -2.6), (1.6, 1.7, 0.2))
_HIP = Joint("left_hip", 500.0, 300.0, 2.0, (-0.6, -2.8, -0.9), (1.3, 0.7, 0.9))
_KNEE = Joint("left_knee", 500.0, 300.0, 1.0, (-0.3, -0.1, -0.5), (0.3, 2.7, 0.5))
_ANKLE = Joint("left_ankle", 400.0, 200.0, 1.0, (-0.8, -1.1, -0.7), (0.6, 1.0, 0.7))

JOINTS = (
    _SPINE,
    _NECK,
    _SHOULDER,
    _ELBOW,
    _mirrored(_SHOULDER),
    _mirrored(_ELBOW),
    _HIP,
    _KNEE,
    _ANKLE,
    _mirrored(_HIP),
    _mirrored(_KNEE),
    _mirrored(_ANKLE),
)
ROOT_COLUMN_WEIGHT = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0)
"""Weights of the root's columns of J: Sec. 5.1 omits its rotation and its height."""

# Order of the character's own bodies (after MuJoCo's world), as in the XML.
BODIES = (
    "pelvis",
    "chest",
    "head",
    "left_upper_arm",
    "left_forearm",
    "left_hand",
    "right_upper_arm",
    "right_forearm",
    "right_hand",
    "left_thigh",
    "left_shin",
    "left_foot",
    "right_thigh",
    "right_shin",
    "right_foot",
)


def asset_path(name: str) -> Path:
    """Path of a file that ships with the package, e.g. `character.xml`.

    Raises:
        FileNotFoundError: the package carries no such file.
    """
    installed = Path(str(resources.files("dcc_jax"))) / "assets"
    checkout = Path(__file__).resolve().parents[2] / "assets"
    root = installed if installed.is_dir() else checkout
    path = root / name
    if not path.exists():
        raise FileNotFoundError(f"the package carries no asset {name!r} ({root})")
    return path


@dataclass(frozen=True, eq=False)
class Character:
    """Static tables of one mass variant. nq = 55, nv = 42, 12 ball joints, 15 bodies.

    The tables over velocities `[42]` follow qvel: root translation (world), root
    rotation (local), then three local rotations a joint.
    """

    mass: float  # kg
    kp: np.ndarray  # [42] N m/rad, zero on the root
    kv: np.ndarray  # [42] N m s/rad, 2 sqrt(kp), zero on the root
    torque_limit: np.ndarray  # [42] N m, infinite on the root (which has no torque)
    column_weight: np.ndarray  # [42] weights of J's columns
    lower: np.ndarray  # [12, 3] rad, least rotation vector of each joint
    upper: np.ndarray  # [12, 3] rad, greatest

    nq = 55
    nv = 42
    num_joints = 12
    num_joint_dofs = 36  # of qvel, after the 6 of the root
    joint_names = tuple(joint.name for joint in JOINTS)
    body_names = BODIES
    stand_height = 0.935  # m, of the pelvis when the soles of the zero pose touch z = 0

    @property
    def scale(self) -> float:
        """Mass relative to the standard character."""
        return self.mass / STANDARD_MASS

    def spec(self) -> mujoco.MjSpec:
        """An editable model of this character alone, masses and inertias scaled."""
        spec = mujoco.MjSpec.from_file(str(asset_path("character.xml")))
        for geom in spec.geoms:
            if math.isfinite(geom.mass):
                geom.mass *= self.scale
        return spec


def load_character(mass: float = STANDARD_MASS) -> Character:
    """The character with masses, inertias, gains and torque limits scaled to `mass`.

    Args:
        mass: kg; the paper's chicken fight uses 36 and 85 (Sec. 5.3).

    Raises:
        ValueError: a mass outside `MASS_RANGE`.
    """
    if not MASS_RANGE[0] <= mass <= MASS_RANGE[1]:
        raise ValueError(f"mass must be in {MASS_RANGE} kg, got {mass}")
    scale = mass / STANDARD_MASS

    def per_dof(root: tuple[float, ...], joints: list[float]) -> np.ndarray:
        return np.concatenate([root, np.repeat(joints, 3)])

    no_root = (0.0,) * 6
    kp = per_dof(no_root, [scale * joint.kp for joint in JOINTS])
    return Character(
        mass=mass,
        kp=kp,
        # The paper's kv = 2 sqrt(kp) holds at 65 kg; mass scales both gains alike.
        kv=2.0 * np.sqrt(scale * kp),
        torque_limit=per_dof(
            (math.inf,) * 6, [scale * joint.torque_limit for joint in JOINTS]
        ),
        column_weight=per_dof(
            ROOT_COLUMN_WEIGHT, [joint.column_weight for joint in JOINTS]
        ),
        lower=np.array([joint.lower for joint in JOINTS]),
        upper=np.array([joint.upper for joint in JOINTS]),
    )


SOLE_FRICTION = 1.0
"""Coulomb coefficient of shoe on floor."""


def compose_scene(
    character: Character,
    *,
    timestep: float = 1.0 / 240.0,
    floor: bool = True,
    extend: Callable[[mujoco.MjSpec], None] | None = None,
) -> mujoco.MjModel:
    """A MuJoCo model of the character in a world.

    Args:
        character: which mass variant.
        timestep: physics step in s.
        floor: add the ground z = 0 and its contact pairs with the eight sole spheres.
        extend: edits the spec before it is compiled: adds bodies, pairs, equalities.

    Raises:
        ValueError: a timestep that is not positive.
    """
    if not timestep > 0.0:
        raise ValueError(f"timestep must be positive, got {timestep}")
    spec = character.spec()
    spec.modelname = "scene"
    spec.option.timestep = timestep
    _add_light_and_camera(spec)
    if floor:
        add_floor(spec)
    if extend is not None:
        extend(spec)
    return spec.compile()


def add_floor(spec: mujoco.MjSpec, name: str = "floor") -> None:
    """Adds the ground plane, and a contact pair with every sole sphere."""
    texture = spec.add_texture(
        name="checker",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.93, 0.93, 0.91],
        rgb2=[0.84, 0.85, 0.84],
        width=256,
        height=256,
    )
    material = spec.add_material(name="ground", texrepeat=[1, 1], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[50, 50, 0.1],
        material=material.name,
        contype=0,
        conaffinity=0,
    )
    for sole in sole_names(spec):
        add_contact(spec, name, sole)


def sole_names(spec: mujoco.MjSpec) -> list[str]:
    """Names of the sole spheres, four a foot."""
    return [geom.name for geom in spec.geoms if "_sole_" in geom.name]


def add_contact(
    spec: mujoco.MjSpec, geom1: str, geom2: str, friction: float = SOLE_FRICTION
) -> None:
    """Adds one contact pair with Coulomb friction (condim 3)."""
    pair = spec.add_pair(geomname1=geom1, geomname2=geom2, condim=3)
    pair.friction = [friction, friction, 0.005, 0.0001, 0.0001]


def _add_light_and_camera(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.76, 0.90],
        rgb2=[0.93, 0.95, 0.97],
        width=256,
        height=1536,
    )
    spec.body("pelvis").add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[1.0, -2.0, 5.0],
        dir=[-0.2, 0.4, -1.0],
        diffuse=[0.80, 0.78, 0.75],
        specular=[0.1, 0.1, 0.1],
        castshadow=True,
    )
    spec.visual.headlight.ambient = [0.50, 0.51, 0.53]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.visual.headlight.specular = [0.05, 0.05, 0.05]
    spec.visual.quality.shadowsize = 2048
    spec.visual.map.haze = 0.4
    spec.visual.rgba.haze = [0.93, 0.95, 0.97, 1.0]
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 720
    spec.body("pelvis").add_camera(
        name="follow",
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[2.2, -2.6, 0.35],
        xyaxes=[0.76, 0.65, 0, -0.08, 0.09, 0.99],
    )
