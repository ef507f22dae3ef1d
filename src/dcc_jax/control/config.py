"""What a user can set about the compliance controller."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

Law = Literal["algorithm_1", "measured", "admittance"]
LAWS: tuple[str, ...] = get_args(Law)


@dataclass(frozen=True)
class ComplianceConfig:
    """Constants of the controller. The level alpha is not one: it may vary by episode.

    Raises:
        ValueError: an unknown `law`, or a number that is not positive and finite.
    """

    law: Law = "admittance"
    """How forces displace the reference: Alg. 1 as printed; Eq. (8) with measured
    velocities, for a task that follows its reference in time; or Eq. (6) and (7) solved
    for u, which holds its stiffness while the character moves."""
    response_time: float = 1.0 / 600.0
    """The h in xd = h J delta_qdd of Alg. 1, s. The paper tuned alpha at 600 Hz (Sec.
    5.1); it stays when the physics runs at another rate."""
    damping: float = 1e-4
    """Added to J W J^T, m^2: J W J^T L of a lever arm of 1 cm is 1/2, of one of 10 cm
    0.99. Alg. 1 yields by its square, Eq. (8) with measured velocities by itself."""
    joint_return_stiffness: float = 100.0
    """Of the spring-damper that takes u back, 1/s^2. Sec. 5.1 names the spring without
    a number; our choice, a time constant of 1 / sqrt(100) = 0.1 s. With `admittance` it
    also takes u to its rest: a short contact counts by its impulse."""
    root_return_stiffness: float = 60.0
    """The same for the root, 1/s^2, our choice: 0.13 s, a step back takes longer."""
    root_stiffness: float = 2000.0
    """kp of the root over the ground in `admittance`, N/m at 65 kg: no PD drives the
    root, so its stiffness is our choice. 100 N displace it by 5 cm at alpha 0.5."""

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise ValueError(f"law must be one of {', '.join(LAWS)}, got {self.law!r}")
        for name, value in vars(self).items():
            if name != "law" and not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")

    @property
    def greatest_alpha(self) -> float:
        """At 1 the stiffness of `admittance` is gone; 0.9 leaves a tenth of it."""
        return 0.9 if self.law == "admittance" else 1.0

    def check_alpha(self, alpha: float, name: str = "alpha") -> None:
        """Raises a ValueError that says `name` where the law cannot have this level."""
        if not 0.0 <= alpha <= self.greatest_alpha:
            raise ValueError(
                f"{name} must be in [0, {self.greatest_alpha:g}], got {alpha}"
            )
