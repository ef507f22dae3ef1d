"""Arms and legs in a foreign skeleton: chains that fit by name, place and length.

A name alone deceives: `LeftShoulder` is a collar bone here and an upper arm there,
`LeftLeg` a shin or a whole leg, and helper joints carry the names of bones. So whole
chains (thigh, shin, foot) are compared, for both sides together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from dcc_jax.motion.formats.skeleton import Motion
from dcc_jax.motion.retarget.names import ARM
from dcc_jax.motion.retarget.words import Named

UNKNOWN = -0.3  # the score of a name that says nothing about a part
CONTRARY = -0.6  # of one that says another part
STILL = -0.4  # of a joint that never turns, where others do
IMPLIED = 0.2  # of the end of a hand or foot that has no name
RATIO = {"thigh": 1.0, "upper_arm": 1.15}  # of the first bone's length to the second's
RATIO_SPREAD = 0.25  # of its logarithm
DETOUR = 5.0  # on the share by which the joints between make a bone longer
UNEQUAL = 4.0  # on the logarithm of the ratio of left to right
DEPTH = 12  # joints above an end that are looked at
KEPT = 12  # chains of a side that are tried with those of the other
CLOSE = 0.1  # scores nearer to each other decide nothing
APART = 0.03  # of the limb: joints farther apart are different


@dataclass(frozen=True, eq=False)
class Tree:
    """A foreign skeleton as matching sees it."""

    motion: Motion
    named: Sequence[Named]
    given: Mapping[str, int]  # node by body, which goes before every guess
    rest: np.ndarray = field(init=False)  # [J, 3] zero pose
    still: np.ndarray = field(init=False)  # [J] joints that never turn
    children: list[list[int]] = field(init=False)

    def __post_init__(self) -> None:
        parents = self.motion.parents
        children: list[list[int]] = [[] for _ in parents]
        for node, parent in enumerate(parents):
            if parent >= 0:
                children[parent].append(node)
        for name, value in (
            ("rest", self.motion.rest()),
            ("still", _still(self.motion)),
            ("children", children),
        ):
            object.__setattr__(self, name, value)

    def distance(self, a: int, b: int) -> float:
        """Between two joints in the zero pose."""
        return float(np.linalg.norm(self.rest[a] - self.rest[b]))

    def walked(self, above: int, below: int) -> float:
        """The length of all bones between two joints, one above the other."""
        length = 0.0
        while below != above:
            length += float(np.linalg.norm(self.motion.offsets[below]))
            below = self.motion.parents[below]
        return length

    def below(self, node: int) -> Iterator[int]:
        """All nodes that hang on one."""
        waiting = list(self.children[node])
        while waiting:
            node = waiting.pop()
            yield node
            waiting += self.children[node]


def _still(motion: Motion) -> np.ndarray:
    """Which joints never turn against their parents while half of the others do."""
    parents = np.maximum(motion.parents, 0)
    some = np.unique(np.linspace(0, len(motion.quats) - 1, 20).astype(int))
    quats = motion.quats[some]
    # The rotation against the parent is constant where these products are.
    own, above = quats, quats[:, parents]
    real = (own * above).sum(-1)
    vector = above[..., :1] * own[..., 1:] - own[..., :1] * above[..., 1:]
    vector -= np.cross(above[..., 1:], own[..., 1:])
    local = np.concatenate([real[..., None], vector], axis=-1)
    same = np.abs((local * local[:1]).sum(-1)).min(axis=0) > 1.0 - 1e-9
    return same & (np.mean(same) < 0.5)


@dataclass(frozen=True)
class Chain:
    """Three joints one below the other, and how well they fit."""

    nodes: tuple[int, int, int]
    score: float
    lengths: tuple[float, float]


def best_pair(
    tree: Tree, parts: tuple[str, str, str]
) -> tuple[tuple[Chain | None, Chain | None], list[str]]:
    """The best chains of the left and of the right side for a kind of limb.

    Returns:
        The chains, none where there is none; and the bodies for which another joint
        would fit as well, with both names.
    """
    left, right = (_side_chains(tree, side, parts) for side in ("left", "right"))
    pairs = []
    for one in left[:KEPT]:
        for two in right[:KEPT]:
            if set(one.nodes) & set(two.nodes):
                continue
            unequal = sum(
                abs(math.log(a / b))
                for a, b in zip(one.lengths, two.lengths, strict=True)
            )
            pairs.append((one.score + two.score - UNEQUAL * unequal, one, two))
    pairs.sort(key=lambda pair: -pair[0])
    if not pairs:
        first, second = (chains[0] if chains else None for chains in (left, right))
        return (first, None if first else second), []
    score, *best = pairs[0]
    doubts = []
    for other_score, *other in pairs[1:]:
        if score - other_score < CLOSE:
            doubts += _differences(tree, parts, best, other)
    return (best[0], best[1]), sorted(set(doubts))


def _differences(
    tree: Tree, parts: tuple[str, str, str], best: list[Chain], other: list[Chain]
) -> list[str]:
    """Bodies for which two pairs of chains name joints at different places."""
    out = []
    for side, one, two in zip(("left", "right"), best, other, strict=True):
        for part, a, b in zip(parts, one.nodes, two.nodes, strict=True):
            if tree.distance(a, b) > APART * sum(one.lengths):
                names = tree.motion.names
                out.append(f"{side}_{part} ({names[a]} or {names[b]})")
    return out


def _side_chains(tree: Tree, side: str, parts: tuple[str, str, str]) -> list[Chain]:
    """The chains of one side, best first."""
    chains = []
    for end, end_score in _ends(tree, side, parts):
        above = tree.motion.ancestors(end)[1 : 1 + DEPTH]
        for middle, upper in combinations(above, 2):
            chain = _chain(tree, side, parts, (upper, middle, end), end_score)
            if chain is not None:
                chains.append(chain)
    return sorted(chains, key=lambda chain: -chain.score)


def _ends(
    tree: Tree, side: str, parts: tuple[str, str, str]
) -> Iterator[tuple[int, float]]:
    """Joints that may end a limb, with their scores."""
    body = f"{side}_{parts[2]}"
    if body in tree.given:
        yield tree.given[body], 1.0
        return
    fitting = {
        node: named.score(parts[2])
        for node, named in enumerate(tree.named)
        if named.score(parts[2]) and named.side == side and not named.aside
    }
    yield from fitting.items()
    if parts == ARM:
        # A fore arm without a hand ends where its children are.
        for node, named in enumerate(tree.named):
            given = tree.given.get(f"{side}_{parts[1]}")
            fits = named.score(parts[1]) and named.side == side and not named.aside
            if given != node and (given is not None or not fits):
                continue
            if not any(below in fitting for below in tree.below(node)):
                yield from ((child, IMPLIED) for child in tree.children[node])


def _chain(
    tree: Tree,
    side: str,
    parts: tuple[str, str, str],
    nodes: tuple[int, int, int],
    end_score: float,
) -> Chain | None:
    """Three joints as a limb; None where they cannot be one."""
    scores = [
        _fit(tree, side, part, node) for part, node in zip(parts, nodes, strict=False)
    ]
    given = [tree.given.get(f"{side}_{part}") for part in parts]
    sided = [
        tree.named[node].side == side or node == known
        for node, known in zip(nodes, given, strict=True)
    ]
    if None in scores[:2] or sum(sided) < 2:
        return None
    upper, lower = tree.distance(*nodes[:2]), tree.distance(*nodes[1:])
    if not min(upper, lower) > 0.05 * (upper + lower) > 0.0:
        return None
    known = [score for score in scores[:2] if score is not None]
    if sum(score < 0.0 for score in known) > 1:
        return None
    apart = math.log(upper / lower / RATIO[parts[0]]) / RATIO_SPREAD
    detour = tree.walked(nodes[0], nodes[1]) / upper
    detour += tree.walked(nodes[1], nodes[2]) / lower - 2.0
    score = sum(known) + end_score - apart**2 - DETOUR * detour
    return Chain(nodes, score, (upper, lower))


def _fit(tree: Tree, side: str, part: str, node: int) -> float | None:
    """How well a joint fits a part of a side; None: not at all."""
    given = tree.given.get(f"{side}_{part}")
    if given is not None:
        return 2.0 if given == node else None
    named = tree.named[node]
    if named.aside or named.side not in (None, side):
        return None
    score = named.score(part)
    if not score:
        score = CONTRARY if named.parts else UNKNOWN
    return score + STILL * bool(tree.still[node])
