"""Which node of a foreign skeleton is which body of ours.

Names are compared in lower case, without separators and without a prefix that all of
them share (`mixamorig:`, `Character1_`). The same word can mean two joints:
`LeftShoulder` is a clavicle where a `LeftArm` exists and the upper arm elsewhere, so
for every body the candidates are tried in order.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.skeleton import Motion
from dcc_jax.motion.formats.text import read_text

_SIDED = {
    "thigh": "femur upleg thigh upperleg hip upleg1 thighbone legup",
    "shin": "tibia leg shin knee lowerleg lowleg calf legdown",
    "foot": "foot ankle",
    "upper_arm": "humerus arm uparm upperarm shldr shoulder",
    "forearm": "radius forearm lowerarm lowarm elbow farm",
}
_SIDED_OPTIONAL = {
    "hand": "hand wrist",
    "toe": "toes toebase toe ball",
}
_PELVIS = "root hips pelvis hip hipcenter"
_HEAD = "head"
_SPELLED = {"left": ("left", "l", "lft"), "right": ("right", "r", "rgt")}

REQUIRED = (
    "pelvis",
    "chest",
    "head",
    *(f"{side}_{part}" for side in _SPELLED for part in _SIDED),
)
OPTIONAL = tuple(f"{side}_{part}" for side in _SPELLED for part in _SIDED_OPTIONAL)


def read_map(path: str | Path) -> dict[str, str]:
    """A name map: JSON, or lines `body = node`; `#` begins a comment.

    Raises:
        MotionError: a line or a body that means nothing.
    """
    text = read_text(path)
    pairs: list[tuple[object, object, int | None]] = []
    if text.lstrip().startswith("{"):
        try:
            pairs = [(body, node, None) for body, node in json.loads(text).items()]
        except (ValueError, RecursionError) as error:
            raise MotionError(path, f"not JSON: {error}") from None
    else:
        for line, raw in enumerate(text.splitlines(), 1):
            words = raw.split("#")[0].strip()
            if words:
                body, equals, node = words.partition("=")
                if not equals:
                    raise MotionError(path, "expected 'body = node'", line)
                pairs.append((body.strip(), node.strip(), line))
    known = (*REQUIRED, *OPTIONAL)
    for body, node, line in pairs:
        if body not in known:
            reason = f"unknown body {str(body)[:40]!r}; known: {', '.join(known)}"
            raise MotionError(path, reason, line)
        if not isinstance(node, str) or not node:
            raise MotionError(path, f"no node for {body!r}", line)
    return {str(body): str(node) for body, node, _ in pairs}


def match(motion: Motion, given: Mapping[str, str] | None = None) -> dict[str, int]:
    """Node of each body of ours: all of `REQUIRED`, and of `OPTIONAL` what is there.

    Args:
        motion: the foreign skeleton.
        given: node names by body, which go before every guess.

    Raises:
        MotionError: a given node does not exist, or a body is not found.
    """
    given = {**motion.roles, **(given or {})}
    bodies: dict[str, int] = {}
    for body, name in given.items():
        if name not in motion.names:
            raise MotionError(motion.path, f"no joint {name!r} for {body}")
        bodies[body] = motion.names.index(name)
    plain = _plain_names(motion)
    _guess_sides(motion, plain, bodies)
    _guess_middle(motion, plain, bodies)
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
    return bodies


def describe(motion: Motion, bodies: Mapping[str, int]) -> str:
    """The match in one line, for the user to check."""
    return ", ".join(f"{body}={motion.names[node]}" for body, node in bodies.items())


def is_plain(motion: Motion, bodies: Mapping[str, int]) -> bool:
    """Whether no name could mean another joint too, so that nobody need check."""
    if motion.roles:
        return True
    plain = _plain_names(motion)
    doubtful = ("hip", "shoulder")
    limbs = [f"{side}_{part}" for side in _SPELLED for part in _SIDED]
    return not any(plain[bodies[limb]].endswith(doubtful) for limb in limbs)


def _plain_names(motion: Motion) -> list[str]:
    """The names without prefix, separators and case; end points get none."""
    joints = [n for n in motion.names if not n.endswith("_end")]
    names = [re.sub(r"^.*[:|]", "", name) for name in motion.names]
    bare = [re.sub(r"^.*[:|]", "", name) for name in joints]
    common = os.path.commonprefix(bare)  # noqa: RUF071 (letters are meant, not paths)
    starts = Counter(n.split("_")[0] + "_" for n in names if "_" in n)
    prefix, count = max(starts.items(), key=lambda item: item[1], default=("", 0))
    sides = {s + "_" for spelled in _SPELLED.values() for s in spelled}
    if not common and count >= 12 and prefix.lower() not in sides:
        common = prefix
    if not re.fullmatch(r"[A-Za-z0-9]*[_\W]|sim|[A-Za-z]*[0-9]+", common):
        common = ""
    return [
        ""
        if motion.names[k].endswith("_end")
        else re.sub(r"[^a-z0-9]", "", name.removeprefix(common).lower())
        for k, name in enumerate(names)
    ]


def _guess_sides(motion: Motion, plain: list[str], bodies: dict[str, int]) -> None:
    """Limbs by name, never the same node twice."""
    for part, words in {**_SIDED, **_SIDED_OPTIONAL}.items():
        for side, spellings in _SPELLED.items():
            if f"{side}_{part}" in bodies:
                continue
            wanted = [
                name
                for word in words.split()
                for s in spellings
                for name in (s + word, word + s, s + word + "joint")
            ]
            node = next(
                (
                    plain.index(name)
                    for name in wanted
                    if name in plain and plain.index(name) not in bodies.values()
                ),
                None,
            )
            if node is not None:
                bodies[f"{side}_{part}"] = node
    for side in _SPELLED:
        _prefer_ankle(motion, plain, bodies, side)


def _prefer_ankle(
    motion: Motion, plain: list[str], bodies: dict[str, int], side: str
) -> None:
    """Where a `foot` hangs on an `ankle`, as in SMPL, it is where the toes begin."""
    foot = bodies.get(f"{side}_foot")
    if foot is None:
        return
    above = motion.ancestors(foot)[1:2]
    if above and "ankle" in plain[above[0]]:
        bodies[f"{side}_foot"] = above[0]
        bodies.setdefault(f"{side}_toe", foot)


def _guess_middle(motion: Motion, plain: list[str], bodies: dict[str, int]) -> None:
    """Pelvis and head by name, the chest as what both arms hang on."""
    for body, words in (("pelvis", _PELVIS), ("head", _HEAD)):
        if body not in bodies:
            found = [plain.index(word) for word in words.split() if word in plain]
            if found:
                bodies[body] = found[0]
    arms = [bodies.get(f"{side}_upper_arm") for side in _SPELLED]
    legs = [bodies.get(f"{side}_thigh") for side in _SPELLED]
    if "pelvis" not in bodies:
        # A root may be a point on the ground; the legs hang on the pelvis.
        node = _common_ancestor(motion, legs[0], legs[1])
        if node is not None:
            bodies["pelvis"] = node
    if "chest" not in bodies:
        node = _common_ancestor(motion, arms[0], arms[1])
        if node is not None and node != bodies.get("pelvis"):
            bodies["chest"] = node


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
    for side in _SPELLED:
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
