"""What the name of a joint says: its side, and how well it fits each part of a body.

Names come as `mixamorig:LeftUpLeg`, `Actor 07_LeftArm`, `CC_Base_L_Thigh`, `thigh.L`,
`Bip01 R Calf`, `lShldrBend`, `lfemur`: words in some order, with a side and a part.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

LEFT, RIGHT = "left", "right"
SIDES = (LEFT, RIGHT)
_SIDE = {
    **dict.fromkeys(("left", "l", "lft", "lf"), LEFT),
    **dict.fromkeys(("right", "r", "rgt", "rt"), RIGHT),
}
# How surely a word is a part: 1 is it and nothing else.
_PARTS = {
    "thigh": "upleg 1 upperleg 1 thigh 1 thighbone 1 femur 1 legup 1 legupper 1 uleg .9"
    " hip .75 leg .5 hipjoint .3",
    "shin": "lowerleg 1 lowleg 1 legdown 1 leglower 1 shin 1 shinbone 1 calf 1 tibia 1"
    " knee 1 lleg .9 leg .85",
    "foot": "foot 1 ankle .95 talus .9",
    "toe": "toe 1 toes 1 toebase 1 ball 1",
    "upper_arm": "upperarm 1 uparm 1 uarm 1 humerus 1 bicep 1 biceps 1 armup 1"
    " armupper 1 arm .8 shldr .8 shoulder .6",
    "forearm": "forearm 1 farm 1 lowerarm 1 lowarm 1 radius 1 ulna .9 armlower 1"
    " elbow 1 armdown 1",
    "hand": "hand 1 wrist .95 palm .7",
    "collar": "clavicle 1 collar 1 collarbone 1 scapula 1 shoulder .7 shldr .3",
    "pelvis": "hips 1 pelvis 1 hip .9 hipcenter 1 root .6",
    "neck": "neck 1 cervical 1 neckbase 1",
    "head": "head 1 skull 1",
}
_ASIDE = frozenset(
    re.findall(
        r"\w+",
        "thumb index middle ring pinky pinkie finger fingers carpal metacarpal "
        "metatarsal hair skirt breast eye eyes jaw ear tongue teeth tail cape cloth "
        "brow lip cheek nose prop weapon ik pole target ctrl control goal effector "
        "socket helper rigmesh volume corrective headtop nub tip site end null mch org "
        "twist roll dummy",
    )
)
"""Words of joints beside the bones: fingers, face, clothes, handles, ends."""
_HARMLESS = frozenset(("twist", "roll"))  # in a chain they may stand for the bone
_TOKEN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@cache
def _scores() -> dict[str, dict[str, float]]:
    """Score by part, by word."""
    words: dict[str, dict[str, float]] = {}
    for part, text in _PARTS.items():
        listed = text.split()
        for word, score in zip(listed[::2], listed[1::2], strict=True):
            words.setdefault(word, {})[part] = float(score)
    return words


@dataclass(frozen=True)
class Named:
    """What a name says."""

    side: str | None
    parts: dict[str, float]  # score by part; none: the words are unknown
    aside: bool  # not a bone of the body, by its words

    def score(self, part: str) -> float:
        """How well the name fits a part, from 0 to 1."""
        return self.parts.get(part, 0.0)


def read_names(names: list[str]) -> list[Named]:
    """What each of some names says, without the words that all begin with."""
    tokens = [list(_tokens(name)) for name in names]
    firsts = Counter(words[0] for words in tokens if len(words) > 1)
    while firsts:
        word, count = firsts.most_common(1)[0]
        if count < 0.6 * len(names) or word in _SIDE or word in _scores():
            break
        tokens = [w[1:] if len(w) > 1 and w[0] == word else w for w in tokens]
        firsts = Counter(words[0] for words in tokens if len(words) > 1)
    return [_named(words) for words in tokens]


def _tokens(name: str) -> Iterator[str]:
    """The words of a name in lower case; a side that is stuck to one is parted."""
    for token in _TOKEN.findall(re.sub(r"^.*[:|]", "", name)):
        word = token.lower()
        # Motive's LUArm and LFArm
        if token in ("LU", "RU", "LF", "RF"):
            yield from (word[0], {"u": "upper", "f": "fore"}[word[1]])
            continue
        if word in _scores() or word in _SIDE or word in _ASIDE:
            yield word
            continue
        for side in ("left", "right", "l", "r"):
            rest = word.removeprefix(side)
            if rest != word and (rest in _scores() or rest in _ASIDE):
                yield from (side, rest)
                break
            rest = word.removesuffix(side)
            if len(side) > 1 and rest != word and rest in _scores():
                yield from (side, rest)
                break
        else:
            yield word


def _named(words: list[str]) -> Named:
    sides = {_SIDE[word] for word in words if word in _SIDE}
    plain = [word for word in words if word not in _SIDE and not word.isdigit()]
    best: dict[str, float] = {}
    longest = 0
    for start in range(len(plain)):
        for stop in range(start + 1, min(start + 3, len(plain)) + 1):
            scores = _scores().get("".join(plain[start:stop]))
            # Of words that overlap the longer says more: a lower leg is no leg.
            if scores and stop - start >= longest:
                best = dict(scores)
                longest = stop - start
    aside = {word for word in plain if word in _ASIDE}
    if aside & _HARMLESS and not aside - _HARMLESS:
        best = {part: 0.8 * score for part, score in best.items()}
        aside = set()
    return Named(sides.pop() if len(sides) == 1 else None, best, bool(aside))
