"""From recorded episodes to numbers: rows, contacts, curves.

Letters: N episodes, T control steps, K contacts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dcc_jax.env.config import CONTROL_RATE
from dcc_jax.play.recording import Recording

DT = 1.0 / CONTROL_RATE
BIN = 3  # control steps in a point of a curve

METRICS: dict[str, tuple[str, str]] = {
    "fell": ("", "share of episodes that end by a fall"),
    "survived": ("s", "until the fall or the end of the episode"),
    "contact/count": ("", "contacts an episode"),
    "contact/peak": ("N", "largest force of a contact"),
    "contact/impulse": ("N s", "impulse of a contact"),
    "contact/seconds": ("s", "duration of a contact"),
    "contact/torque": ("N m", "RMS torque of the joints while a force acts"),
    "contact/foot_low": ("m", "lowest sole during a contact"),
    "contact/pelvis_low": ("m", "lowest pelvis during a contact"),
    "contact/energy": ("J", "change of the character's energy over a contact"),
    "force/mean": ("N", "mean force, contact or not"),
    "force/max": ("N", "largest force of an episode"),
    "torque/rms": ("N m", "RMS torque of the joints"),
    "torque/peak": ("N m", "largest torque of an episode"),
    "power": ("W", "sum over the joints of |torque x speed|"),
    "u/joints": ("rad", "displacement of the joints, mean norm of log u"),
    "u/joints_max": ("rad", "the largest of an episode"),
    "u/root_max": ("m", "largest displacement of the root"),
    "energy": ("J", "kinetic and potential energy of the character"),
    "skate": ("m/s", "speed of soles that stand"),
    "range": ("rad", "largest excess over a joint's range"),
    "style/nearest": ("m", "distance of pose pairs to the nearest clip pair"),
    "r_p": ("", "positional reward"),
    "r_task": ("", "task reward"),
}
"""Columns of the rows: unit and meaning. A task's own come on top, as
`task/<name>/mean`, `/min`, `/max` and `/final`.

Forces are those passed to the compliance controller, measured at the physics rate. A
contact is a time without pause in which one acts, to the control step; where a row has
a contact metric it is the mean over the contacts of the episode.
"""

CURVES = (
    ("force_peak", "N"),
    ("torque_rms", "N m"),
    ("displacement", "rad"),
    ("root_displacement", "m"),
    ("energy", "J"),
    ("foot_height", "m"),
    ("pelvis_height", "m"),
)
"""Recorded numbers that are drawn over time, beside the task's own."""


def rows(
    recording: Recording,
    nearest: np.ndarray,
    contacts: list[list[dict[str, float]]],
    clock: str | None,
) -> list[dict[str, float]]:
    """The metrics of each episode.

    Args:
        recording: of N episodes.
        nearest: style distance [C, N] in m at the end of each chunk.
        contacts: of each episode, from `contacts_of`.
        clock: a number of the task that is no measure of anything.
    """
    return [
        _row(recording, nearest, of_episode, n, f"task/{clock}")
        for n, of_episode in enumerate(contacts)
    ]


def contacts_of(recording: Recording, n: int) -> list[dict[str, float]]:
    """The contacts of one episode, in order."""
    lasting = int(recording.alive[:, n].sum())
    numbers = {name: x[:lasting, n] for name, x in recording.numbers.items()}
    edges = np.diff(np.pad(numbers["contact_share"] > 0.0, 1).astype(int))
    starts, stops = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [
        _contact(numbers, a, b)
        for a, b in zip(starts.tolist(), stops.tolist(), strict=True)
    ]


def _contact(numbers: dict[str, np.ndarray], a: int, b: int) -> dict[str, float]:
    """One contact, in control steps a to b."""
    part = {name: x[a:b] for name, x in numbers.items()}
    share = part["contact_share"]
    energy = numbers["energy"]
    return {
        "start": a * DT,
        "peak": float(part["force_peak"].max()),
        "impulse": float(part["impulse"].sum()),
        "seconds": float(share.sum() * DT),
        "torque": _rms(part["contact_torque"], share),
        "foot_low": float(part["foot_height"].min()),
        "pelvis_low": float(part["pelvis_height"].min()),
        "energy": float(energy[b - 1] - energy[max(a - 1, 0)]),
    }


def _row(
    recording: Recording,
    nearest: np.ndarray,
    contacts: list[dict[str, float]],
    n: int,
    clock: str,
) -> dict[str, float]:
    lasting = int(recording.alive[:, n].sum())
    numbers = {name: x[:lasting, n] for name, x in recording.numbers.items()}
    stands = numbers["stands"]
    row = {
        "fell": float(recording.fell[n]),
        "survived": lasting * DT,
        "contact/count": float(len(contacts)),
        **{
            name: _mean([contact[name.partition("/")[2]] for contact in contacts])
            for name in METRICS
            if name.startswith("contact/") and name != "contact/count"
        },
        "force/mean": float(numbers["impulse"].sum() / (lasting * DT)),
        "force/max": float(numbers["force_peak"].max()),
        "torque/rms": _rms(numbers["torque_rms"]),
        "torque/peak": float(numbers["torque_peak"].max()),
        "power": float(numbers["power"].mean()),
        "u/joints": float(numbers["displacement"].mean()),
        "u/joints_max": float(numbers["displacement"].max()),
        "u/root_max": float(numbers["root_displacement"].max()),
        "energy": float(numbers["energy"].mean()),
        "skate": _ratio(numbers["slip"].sum(), stands.sum() * DT),
        "range": float(numbers["range_excess"].max()),
        "style/nearest": _mean(nearest[recording.pairs_alive[:, n], n]),
        "r_p": float(numbers["r_p"].mean()),
        "r_task": float(numbers["r_task"].mean()),
    }
    for name, values in numbers.items():
        if name.startswith("task/") and name != clock:
            row |= _reduced(name, values)
    return row


def _reduced(name: str, values: np.ndarray) -> dict[str, float]:
    valid = values[~np.isnan(values)]
    if valid.size == 0:
        return {f"{name}/{kind}": np.nan for kind in ("mean", "min", "max", "final")}
    return {
        f"{name}/mean": float(valid.mean()),
        f"{name}/min": float(valid.min()),
        f"{name}/max": float(valid.max()),
        f"{name}/final": float(valid[-1]),
    }


def curves(recording: Recording, clock: str | None) -> dict[str, list[list[float]]]:
    """Means over episodes against the time since an event: (time, mean, half width).

    Args:
        recording: of N episodes.
        clock: the task's number, in s, that events reset; None: the time itself.
            Steps before the first event of an episode do not count.

    Returns:
        by name, three lists: s, the mean, and 1.96 standard errors over the episodes.
    """
    alive = recording.alive
    time = DT * np.arange(1, len(alive) + 1)[:, None] * np.ones(alive.shape)
    if clock is not None:
        time = recording.numbers[f"task/{clock}"]
        back = np.diff(time, axis=0, prepend=time[:1]) < 0.0
        alive = alive & np.logical_or.accumulate(back) & ~np.isnan(time)
    names = [name for name, _ in CURVES]
    names += [
        n for n in recording.numbers if n.startswith("task/") and n != f"task/{clock}"
    ]
    bins = np.floor(np.where(alive, time, 0.0) / (BIN * DT) + 1e-3).astype(int)
    return {name: _curve(recording.numbers[name], bins, alive) for name in names}


def _curve(
    values: np.ndarray, bins: np.ndarray, alive: np.ndarray
) -> list[list[float]]:
    """Episodes are averaged first: their own steps are not independent."""
    alive = alive & ~np.isnan(values)
    count = int(bins.max()) + 1
    episode = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    total, number = np.zeros((2, count, values.shape[1]))
    np.add.at(total, (bins[alive], episode[alive]), values[alive])
    np.add.at(number, (bins[alive], episode[alive]), 1.0)
    points: list[list[float]] = [[], [], []]
    for at in range(count):
        there = number[at] > 0
        if there.sum() < 2:
            continue
        means = total[at, there] / number[at, there]
        points[0].append((at + 0.5) * BIN * DT)
        points[1].append(float(means.mean()))
        points[2].append(float(1.96 * means.std(ddof=1) / np.sqrt(there.sum())))
    return points


def survival(recording: Recording) -> list[float]:
    """Share of episodes that have not fallen after each control step."""
    fallen = ~recording.alive & recording.fell
    return (1.0 - fallen.mean(axis=1)).tolist()


def _rms(values: np.ndarray, weight: np.ndarray | None = None) -> float:
    weight = np.ones(len(values)) if weight is None else weight
    return float(np.sqrt(np.sum(weight * values**2) / np.sum(weight)))


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _ratio(a: float, b: float) -> float:
    return float(a / b) if b > 0.0 else np.nan
