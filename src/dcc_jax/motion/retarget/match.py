"""Which joint of a foreign skeleton is which body of ours."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import Motion
from dcc_jax.motion.retarget.chains import Tree, best_pair
from dcc_jax.motion.retarget.names import ARM, LEG, REQUIRED
from dcc_jax.motion.retarget.words import SIDES, read_names

SURE = 0.8  # the score of a name above which nobody need check it


def match(
    motion: Motion, given: Mapping[str, str] | None = None
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Node of each body of ours, and what the user should check.

    A body's node is the joint at its upper end: the elbow of the fore arm.

    Args:
        motion: the foreign skeleton.
        given: node names by body, which go before every guess.

    Raises:
        MotionError: a given node does not exist, a body is not found, or two joints
            fit one equally well.
    """
    named = read_names(list(motion.names))
    tree = Tree(motion, named, _given(motion, {**motion.roles, **(given or {})}))
    bodies = dict(tree.given)
    doubts: list[str] = []
    for parts in (LEG, ARM):
        pair, unclear = best_pair(tree, parts)
        doubts += unclear
        for side, chain in zip(SIDES, pair, strict=True):
            for part, node in zip(parts, chain.nodes if chain else (), strict=False):
                bodies.setdefault(f"{side}_{part}", node)
    if doubts:
        reason = f"cannot tell {', '.join(doubts)}; say which with --map"
        raise MotionError(motion.path, reason)
    _middle(tree, bodies)
    _toes(tree, bodies)
    missing = [body for body in REQUIRED if body not in bodies]
    if missing:
        used = set(bodies.values())
        free = [n for k, n in enumerate(motion.names) if k not in used]
        raise MotionError(
            motion.path,
            f"found no joint for {', '.join(missing)} among {', '.join(free[:40])}; "
            "say which with --map",
        )
    _check_order(motion, bodies)
    return bodies, _notes(tree, bodies)


def _given(motion: Motion, names: Mapping[str, str]) -> dict[str, int]:
    bodies = {}
    for body, name in names.items():
        if name not in motion.names:
            raise MotionError(motion.path, f"no joint {name!r} for {body}")
        bodies[body] = motion.names.index(name)
    return bodies


def _notes(tree: Tree, bodies: Mapping[str, int]) -> tuple[str, ...]:
    """The match for the user to check, where some name is not beyond doubt."""
    unsure = [
        body
        for body, node in bodies.items()
        if body not in tree.given
        and body.partition("_")[2] in (*LEG, *ARM[:2])
        and tree.named[node].score(body.partition("_")[2]) < SURE
    ]
    if "head" not in tree.given and not tree.named[bodies["head"]].score("head"):
        unsure.append("head")
    if not unsure:
        return ()
    names = tree.motion.names
    listed = ", ".join(f"{body}={names[node]}" for body, node in bodies.items())
    return (f"please check the joints: {listed}",)


def _middle(tree: Tree, bodies: dict[str, int]) -> None:
    """Pelvis and chest from what the limbs hang on, and the head above them."""
    motion = tree.motion
    legs = [bodies.get(f"{side}_thigh") for side in SIDES]
    arms = [bodies.get(f"{side}_upper_arm") for side in SIDES]
    hips = _common_ancestor(motion, legs[0], legs[1])
    if hips is not None:
        bodies.setdefault("pelvis", hips)
    shoulders = _common_ancestor(motion, arms[0], arms[1])
    pelvis = bodies.get("pelvis")
    if shoulders is None or pelvis is None:
        return
    spine = [
        node
        for node in motion.ancestors(shoulders)
        if pelvis in motion.ancestors(node)[1:]
    ]
    # Arms may hang on the neck, which turns with the head.
    below = [node for node in spine if not tree.named[node].score("neck")]
    if below or spine:
        bodies.setdefault("chest", (below or spine)[0])
    head = _head(tree, bodies, shoulders)
    if head is not None:
        bodies.setdefault("head", head)


def _head(tree: Tree, bodies: Mapping[str, int], shoulders: int) -> int | None:
    """The joint called head, or else the last above the shoulders that has an end."""
    chest = bodies.get("chest", shoulders)
    limbs = {bodies[f"{s}_upper_arm"] for s in SIDES}
    above: list[int] = []
    waiting = [chest]
    while waiting:
        node = waiting.pop()
        named = tree.named[node]
        if node in limbs or named.side or (named.aside and not named.score("head")):
            continue
        above.append(node)
        waiting += tree.children[node]
    called = [
        n for n in above if tree.named[n].score("head") and not tree.named[n].aside
    ]
    if called:
        return min(called, key=lambda n: len(tree.motion.ancestors(n)))
    rising = [
        n
        for n in above[1:]
        if tree.children[n] and n not in tree.motion.ancestors(chest)
    ]
    rising = [n for n in rising if not any(limb in tree.below(n) for limb in limbs)]
    ends = [n for n in rising if not set(tree.children[n]) & set(rising)]
    return ends[0] if len(ends) == 1 else None


def _toes(tree: Tree, bodies: dict[str, int]) -> None:
    """What hangs on a foot: its toes, or the end of it that goes furthest."""
    for side in SIDES:
        foot = bodies.get(f"{side}_foot")
        if foot is None or f"{side}_toe" in bodies:
            continue
        named = [n for n in tree.below(foot) if tree.named[n].score("toe")]
        below = named or [n for n in tree.children[foot] if not tree.named[n].aside]
        below = [n for n in below if tree.distance(n, foot) > 0.0]
        if below:
            bodies[f"{side}_toe"] = min((tree.walked(foot, n), n) for n in below)[1]


def _common_ancestor(motion: Motion, a: int | None, b: int | None) -> int | None:
    if a is None or b is None:
        return None
    above = set(motion.ancestors(a)[1:])
    return next((node for node in motion.ancestors(b)[1:] if node in above), None)


def _check_order(motion: Motion, bodies: Mapping[str, int]) -> None:
    """Limbs must hang together: the shin below the thigh, and so on.

    Raises:
        MotionError: a body's node does not hang on that of its parent body.
    """
    chains: list[tuple[str, ...]] = [("pelvis", "chest", "head")]
    for side in SIDES:
        chains.append(("pelvis", f"{side}_thigh", f"{side}_shin", f"{side}_foot"))
        chains.append(("pelvis", f"{side}_upper_arm", f"{side}_forearm"))
    for chain in chains:
        for parent, child in pairwise(chain):
            if bodies[parent] not in motion.ancestors(bodies[child])[1:]:
                raise MotionError(
                    motion.path,
                    f"{motion.names[bodies[child]]!r} ({child}) does not hang on "
                    f"{motion.names[bodies[parent]]!r} ({parent})",
                )
