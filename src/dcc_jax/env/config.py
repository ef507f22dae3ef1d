"""What a user can set about an environment."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from dcc_jax.character import CONTROL_DT, CONTROL_RATE
from dcc_jax.control.config import ComplianceConfig
from dcc_jax.env.rewards import RewardConfig

Imitation = Literal["task", "adversarial", "tracking"]


@dataclass(frozen=True)
class EnvConfig:
    """Physics, episodes, the level of compliance.

    Raises:
        ValueError: a value out of its range.
    """

    physics_rate: int = 240
    """Physics steps a second, a multiple of 30; the paper has 600 (Sec. 5.1). 240 is
    stable with the implicit PD (docs/performance.md)."""

    newton_iterations: int = 8
    """Of the contact solver, at most (docs/performance.md)."""

    alpha: float = 0.16
    """Level of compliance, in [0, 1], with `admittance` in [0, 0.9] (Sec. 5.2 mostly
    uses 0.16)."""

    alpha_max: float | None = None
    """With it alpha is drawn from [alpha, alpha_max] in every episode and observed."""

    episode_seconds: float = 10.0
    """Episodes are truncated then, and where a clip that is followed in time ends."""

    random_start: bool = True
    """Episodes begin anywhere in a clip (Sec. 5.1); without, at its start."""

    mass: float = 65.0
    """Of the character, kg; gains scale with it (Sec. 5.1, 5.3)."""

    displace_target: bool = True
    """PD target a (+) u; without, a alone, as Sec. 4 can also be read."""

    fall_height: float = 0.55
    """m; with the pelvis lower than this above the ground, the character has fallen.
    Where a clip goes lower, it may be lower by 0.1 m than any clip."""

    limb_clearance: float = 0.10
    """m; a body other than shins and feet whose origin comes so close to the ground has
    touched it. Where a clip goes lower, it may be lower by 0.05 m than any clip."""

    clips: tuple[str, ...] = ()
    """Clips `*.npz`, motion files such as `*.bvh`, which are imported, or names of the
    package's clips; empty: the task's own choice."""

    imitation: Imitation = "task"
    """What r_q is: `adversarial`, the discriminator's score, Eq. (13); `tracking`, the
    distance to the reference's pose, of which actions are then offsets; or what the
    `task` says."""

    observe_reference: bool = True
    """The policy observes the pose that it tracks, a control step ahead; without, its
    phase alone, as in the paper. Says nothing where no pose is tracked."""

    velocity_time: float = CONTROL_DT
    """s; 1 m/s counts as much as this many m in what the discriminator sees. A small
    one hides how the feet slide, a large one lets it see the noise of exploration."""

    turn_arm: float = 1.0
    """m; an entry of a body's two columns, which have length 1, counts as much as this
    many m in what the discriminator sees. What varies by more than
    `disc.feature_floor` is divided by how much it varies, whatever it counts as."""

    compliance: ComplianceConfig = field(default_factory=ComplianceConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)

    def __post_init__(self) -> None:
        if self.physics_rate < 60 or self.physics_rate % CONTROL_RATE:
            raise ValueError(
                "env.physics_rate must be a multiple of 30, 60 or more, got "
                f"{self.physics_rate}"
            )
        self.compliance.check_alpha(self.alpha, "env.alpha")
        if self.alpha_max is not None:
            self.compliance.check_alpha(self.alpha_max, "env.alpha_max")
            if self.alpha_max < self.alpha:
                raise ValueError(
                    f"env.alpha_max must be at least alpha, got {self.alpha_max}"
                )
        for name in ("velocity_time", "turn_arm"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"env.{name} must be positive, got {getattr(self, name)}"
                )
        if not self.episode_seconds > 0.1:
            raise ValueError(
                f"env.episode_seconds must be more than 0.1, got {self.episode_seconds}"
            )

    @property
    def control_steps(self) -> int:
        """Physics steps of a control step."""
        return self.physics_rate // CONTROL_RATE
