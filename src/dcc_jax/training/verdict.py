"""What the numbers of a training say, in a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

WON = 1.6
"""Margin of the discriminator's mean scores, of 2 at most, from which on its reward is
nearly the same whatever the policy does."""
WINDOW = 3  # measurements that are averaged
CHANGE = 0.03  # share by which their mean has to change
SHARE = 0.1  # of the updates, over which the reward of tracking is averaged
STEP = 0.01  # by which that mean has to change


def verdict(rows: Sequence[dict[str, float]]) -> str:
    """How far the motion is from its clips, whether that still changes, and whether the
    discriminator still teaches; where none does, how well the reference is followed.

    Args:
        rows: the metrics of a run, an entry an update; see `logs.read`.

    Returns:
        A sentence; an empty one where there is nothing to say yet.
    """
    margin = [row["disc/margin"] for row in rows[-50:] if "disc/margin" in row]
    if not margin:
        return _followed([row["reward/r_q"] for row in rows if "reward/r_q" in row])
    # Where every environment was just reset there is a floor and no distance.
    measured = [row for row in rows if row.get("style/nearest") is not None]
    if not measured:
        return ""
    nearest = [row["style/nearest"] for row in measured]
    text = f"the motion is {1e3 * nearest[-1]:.0f} mm away from its clips"
    text += f", {nearest[-1] / measured[-1]['style/floor']:.1f} times the floor"
    text += _trend(nearest)
    if fmean(margin) > WON:
        text += (
            f"; the discriminator has won (it scores clips {fmean(margin):.1f} of 2 "
            "higher) and teaches little: raise disc.instance_noise or "
            "disc.gradient_penalty"
        )
    return text


def _followed(r_q: Sequence[float]) -> str:
    some = int(SHARE * len(r_q))
    if not some:
        return ""
    before, after = fmean(r_q[-2 * some : -some]), fmean(r_q[-some:])
    text = f"it follows its reference with r_q = {after:.2f}, of 1 at most"
    if abs(after - before) < STEP:
        return f"{text}, no longer rising"
    return f"{text}, {'still rising' if after > before else 'falling'}"


def _trend(away: Sequence[float]) -> str:
    if len(away) < 2 * WINDOW:
        return ""
    before, after = fmean(away[-2 * WINDOW : -WINDOW]), fmean(away[-WINDOW:])
    if after < (1.0 - CHANGE) * before:
        return ", still falling"
    if after > (1.0 + CHANGE) * before:
        return ", rising"
    return ", no longer falling"
