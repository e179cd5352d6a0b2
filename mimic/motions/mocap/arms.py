"""Finds the arms of a body among captured points, by their names and by the skeleton."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mimic.motions.mocap.points import PointMotion

SIDES = ("left", "right")
_SHORT = 0.25  # of the forearm's length; a shorter segment beyond the wrist is not the hand

# Words of a name without its side: of skeletons (BVH, SMPL-X, pose estimators) and marker sets (Plug-in Gait).
_UPPER_ARM = {"arm", "upperarm", "uparm", "humerus"}
_SHOULDER = {"shoulder", "sho", "shldr", "acromion", "gh", *_UPPER_ARM}
_ELBOW = {"elbow", "forearm", "lowerarm", "lowarm", "radius", "elb", "elbl", "elbm"}
_WRIST = {"wrist", "hand", "wra", "wrb", "wri", "wrl", "wrm"}
_HAND = {
    "middle1",
    "middlefinger1",
    "handmiddle1",
    "middle",
    "fingerbase",
    "index",
    "index1",
    "handindex1",
    "fin",
    "hand",
}
_SIDE_WORDS = {"l": "left", "left": "left", "r": "right", "right": "right"}


class ArmPoints(NamedTuple):
    """Names of an arm's points; several names stand for their mean.

    Attributes:
      side: "left" or "right".
      shoulder, elbow, wrist, hand: names; `hand` is empty where no point beyond the wrist is known.
    """

    side: str
    shoulder: tuple[str, ...]
    elbow: tuple[str, ...]
    wrist: tuple[str, ...]
    hand: tuple[str, ...]


def find_arms(motion: PointMotion) -> dict[str, ArmPoints]:
    """The arms of a body by their side, those that are complete from shoulder to wrist."""
    words = {name: _words(name) for name in motion.names}
    arms = {}
    for side in SIDES:
        own = {name: word for name, (of_side, word) in words.items() if of_side == side}
        find = _in_skeleton if any(parent >= 0 for parent in motion.parents) else _among_markers
        if arm := find(motion, side, own):
            arms[side] = arm
    return arms


def _among_markers(motion: PointMotion, side: str, own: Mapping[str, str]) -> ArmPoints | None:
    def named(among: set[str]) -> tuple[str, ...]:
        return tuple(name for name, word in own.items() if word in among)

    # A collar is called shoulder where the shoulder is called arm, and a wrist hand where it has no other name.
    shoulder = named(_UPPER_ARM) or named(_SHOULDER)
    elbow, wrist = named(_ELBOW), named(_WRIST - {"hand"}) or named({"hand"})
    hand = next((points for word in sorted(_HAND) if (points := named({word})) and points != wrist), ())
    return ArmPoints(side, shoulder, elbow, wrist, hand) if shoulder and elbow and wrist else None


def _in_skeleton(motion: PointMotion, side: str, own: Mapping[str, str]) -> ArmPoints | None:
    """From the elbow: the shoulder is the joint before it, the wrist and the hand follow it."""
    names = motion.names
    elbows = [name for name, word in own.items() if word in _ELBOW and word not in ("elbm", "elbl")]
    for elbow in elbows:
        index = names.index(elbow)
        shoulder = _ancestor(motion, index)
        wrist = _descendant(motion, index, 0.0, prefer=_WRIST)
        if shoulder is None or wrist is None:
            continue
        forearm = _distance(motion, index, wrist)
        hand = _descendant(motion, wrist, _SHORT * forearm, prefer=_HAND)
        return ArmPoints(
            side, (names[shoulder],), (elbow,), (names[wrist],), (names[hand],) if hand is not None else ()
        )
    return None


def _ancestor(motion: PointMotion, index: int) -> int | None:
    """The nearest ancestor at another place."""
    parent = motion.parents[index]
    while parent >= 0 and _distance(motion, parent, index) <= 0:
        parent = motion.parents[parent]
    return parent if parent >= 0 else None


def _descendant(motion: PointMotion, index: int, beyond: float, prefer: set[str]) -> int | None:
    """The first descendant further away than a distance, along the children with preferred names, never the thumb."""
    current = index
    while True:
        children = [i for i, parent in enumerate(motion.parents) if parent == current]
        fingers = [i for i in children if "thumb" not in motion.names[i].lower()]
        if not fingers:
            return None
        preferred = [i for i in fingers if _words(motion.names[i])[1] in prefer]
        current = (preferred or fingers)[0]
        if _distance(motion, index, current) > beyond:
            return current


def _distance(motion: PointMotion, first: int, second: int) -> float:
    """Median distance of two points, in the unit of the motion; 0 where they coincide."""
    distance = np.linalg.norm(motion.positions[:, first] - motion.positions[:, second], axis=1)
    median = float(np.nanmedian(distance)) if np.isfinite(distance).any() else 0.0
    return median if median > 1e-9 else 0.0


def _words(name: str) -> tuple[str | None, str]:
    """Side of a point, if its name states one, and the rest of the name in lower case without separators."""
    base = re.split(r"[:|]", name)[-1]
    words = re.findall(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+", base)
    words = [word.lower() for word in words if word.lower() not in ("bip", "def", "org", "jnt")]
    for position, word in enumerate(words):
        if word in _SIDE_WORDS:
            rest = words[:position] + words[position + 1 :]
            return _SIDE_WORDS[word], "".join(_without_numbers_of_biped(rest))
    joined = "".join(words)
    known = _SHOULDER | _ELBOW | _WRIST | _HAND
    if joined[:1] in _SIDE_WORDS and joined[1:] in known:  # markers: LSHO, and lradius
        return _SIDE_WORDS[joined[0]], joined[1:]
    if words and words[0][:1] in _SIDE_WORDS and "".join([words[0][1:], *words[1:]]) in known:  # Poser: lForeArm
        return _SIDE_WORDS[words[0][0]], "".join([words[0][1:], *words[1:]])
    return None, joined


def _without_numbers_of_biped(words: Sequence[str]) -> Sequence[str]:
    """3ds Max names joints "Bip01 L Forearm"."""
    return words[1:] if len(words) > 1 and words[0].isdigit() else words
