"""The joints that a foreign skeleton has to have, and maps of their names."""

from __future__ import annotations

import json
from pathlib import Path

from dcc_jax.motion.formats.npz import MotionError
from dcc_jax.motion.formats.text import read_text
from dcc_jax.motion.retarget.words import SIDES

LEG = ("thigh", "shin", "foot")
ARM = ("upper_arm", "forearm", "hand")
REQUIRED = (
    "pelvis",
    "chest",
    "head",
    *(f"{side}_{part}" for side in SIDES for part in (*LEG, *ARM[:2])),
)
OPTIONAL = tuple(f"{side}_{part}" for side in SIDES for part in ("hand", "toe"))


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
