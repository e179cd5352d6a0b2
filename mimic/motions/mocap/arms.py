"""Finds the arms of a body among captured points, by their names and by the skeleton."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from mimic.motions.mocap.names import INNER, OUTER, Part, is_thumb, is_twist, parts_of
from mimic.motions.mocap.points import SIDES, ArmPoints, PointMotion, median_length

# Of the forearm's length: a point beyond the wrist that is nearer is not the hand, and one farther away a prop.
_SHORT, _LONG = 0.25, 0.9
_MARKED = 1  # rank of words from which they are those of markers, and not of joints' centres
_CLUSTER = 0.8  # of the forearm's length: a point on the upper arm that is nearer to the elbow is not the shoulder
_NAMED = 40  # points in a message

_Named = Mapping[int, Part]  # of points that name a part of the body, by their index


def find_arms(motion: PointMotion) -> dict[str, ArmPoints]:
    """The arms of a body by their side, those that are complete from shoulder to wrist.

    An arm whose points the user has named counts as it is. Where no name states a side, the only arm is "right".
    """
    named = {i: part for i, part in enumerate(parts_of(motion.names)) if part is not None}
    named = {i: part for i, part in named.items() if _is_seen(motion, i)} or named
    has_skeleton = any(parent >= 0 for parent in motion.parents)
    arms = {}
    for side, own in _by_side(named).items():
        find = _in_skeleton if has_skeleton else _among_markers
        if arm := find(motion, side, own):
            arms[side] = arm
    if motion.named:
        arms[motion.named.side] = motion.named
    return {side: arms[side] for side in SIDES if side in arms}


def find_facing(motion: PointMotion) -> dict[str, tuple[str, ...]]:
    """Names of the left and right points between which the body faces: of the shoulders, or else of the hips.

    A shoulder may be that of an arm that is not complete. Empty where neither is known on both sides.
    """
    named = {i: part for i, part in enumerate(parts_of(motion.names)) if part is not None and _is_seen(motion, i)}
    joints = any(part.part == "elbow" for part in named.values())
    sides = {side: own for side, own in _by_side(named).items() if side}
    pick = (lambda own: _pick(own, "shoulder")) if joints else (lambda own: _shoulder(own, joints))
    shoulders = {side: _names(motion, pick(own)) for side, own in sides.items()}
    shoulders |= {side: arm.shoulder for side, arm in find_arms(motion).items()}
    hips = {side: _names(motion, [i for i in own if own[i].part == "hip"]) for side, own in sides.items()}
    return next((points for points in (shoulders, hips) if all(points.values())), {})


def persons(motion: PointMotion) -> dict[str, list[int]]:
    """Indices of the points of each person with an arm, by the person's name: a prefix, or the root of a skeleton."""
    groups: dict[str, list[int]] = {}
    if any(parent >= 0 for parent in motion.parents):
        roots: list[int] = []
        for index, parent in enumerate(motion.parents):
            roots.append(roots[parent] if parent >= 0 else index)
            groups.setdefault(motion.names[roots[index]], []).append(index)
    else:
        for index, part in enumerate(parts_of(motion.names)):
            if part is not None:
                groups.setdefault(part.prefix, []).append(index)
    return {name: indices for name, indices in groups.items() if find_arms(motion.subset(indices))}


def unnamed(motion: PointMotion) -> str:
    """What to do where no arm is found, with the names of the points that were seen."""
    names = [name for index, name in enumerate(motion.names) if _is_seen(motion, index)]
    rest = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return (
        "no arm was found whose points have names that are known, and were seen: state them by capture.shoulder= "
        f"capture.elbow= capture.wrist= capture.hand=, of {', '.join(names[:_NAMED]) or 'none'}{rest}"
    )


def _by_side(named: _Named) -> dict[str, dict[int, Part]]:
    sides = {side: {i: part for i, part in named.items() if part.side == side} for side in SIDES}
    elbows = [part for part in named.values() if part.part in ("elbow", "forearm")]
    prefixes = {part.prefix for part in elbows}  # with several, these may be persons or sides
    if not any(part.side for part in elbows) and len(prefixes) == 1:
        own = {i: part for i, part in named.items() if not part.side and part.prefix in prefixes}
        sides["right"] |= {i: part._replace(side="right") for i, part in own.items()}
    return sides


def _is_seen(motion: PointMotion, index: int) -> bool:
    """Whether a point was seen; in a single sample, which is one of many to come, each one counts."""
    return len(motion.positions) == 1 or bool(np.isfinite(motion.positions[:, index]).all(axis=1).any())


def _names(motion: PointMotion, indices: Iterable[int]) -> tuple[str, ...]:
    return tuple(motion.names[index] for index in indices)


def _among_markers(motion: PointMotion, side: str, own: _Named) -> ArmPoints | None:
    # Where elbows are named, so are the other joints: a marker on the forearm is no elbow then.
    joints = any(part.part == "elbow" for part in own.values())
    shoulder = _shoulder(own, joints)
    elbow = _pick(own, "elbow") or _pick(own, "forearm")
    wrist = _pick(own, "wrist") or _pick(own, "hand")
    beyond = {i: part for i, part in own.items() if i not in wrist}
    hand = _pick(beyond, "hand") or _pick(beyond, "index")
    if not shoulder or not elbow or not wrist:
        return None
    if joints and own[shoulder[0]].part == "upper_arm":
        upper, forearm = (_distance(motion, elbow[0], points[0]) for points in (shoulder, wrist))
        if upper < _CLUSTER * forearm:
            return None
    return ArmPoints(side, *(_names(motion, points) for points in (shoulder, elbow, wrist, hand)))


def _shoulder(own: _Named, joints: bool) -> list[int]:
    """By joints the shoulder; by segments the upper arm, and the collar is called shoulder."""
    order = ("shoulder", "upper_arm") if joints else ("upper_arm", "shoulder")
    return next((points for part in order if (points := _pick(own, part))), [])


def _pick(own: _Named, part: str) -> list[int]:
    """The points of a joint: two on both sides of it, or those of the best word and the lowest number.

    A point whose name states no side of the joint is the outer one where another is the inner, as ELB beside MEL.
    """
    found = {i: of for i, of in own.items() if of.part == part}
    for rank in sorted({of.rank for of in found.values()}):
        pair = [i for i, of in found.items() if of.rank == rank and of.place]
        if {found[i].place for i in pair} == {INNER, OUTER}:
            return pair
    inner, plain = ([i for i, of in found.items() if of.place == place and of.rank >= _MARKED] for place in (INNER, ""))
    if part == "elbow" and len(inner) == len(plain) == 1 and len(found) == 2:
        return plain + inner
    best = min((of.rank for of in found.values()), default=0)
    numbers = {i: of.number for i, of in found.items() if of.rank == best}
    return [i for i, number in numbers.items() if number == min(numbers.values())]


def _in_skeleton(motion: PointMotion, side: str, own: _Named) -> ArmPoints | None:
    """From the elbow: the shoulder is an ancestor, the wrist and the hand are descendants."""
    elbows = [i for i, part in own.items() if part.part in ("elbow", "forearm")]
    for elbow in sorted(elbows):  # parents come first: of two halves of a forearm the upper one
        shoulder, wrist = _ancestor(motion, elbow, own), _first_below(motion, elbow, own)
        if shoulder is None or wrist is None:
            continue
        hand = _hand(motion, wrist, own, _distance(motion, elbow, wrist))
        points = [shoulder], [elbow], [wrist], [] if hand is None else [hand]
        return ArmPoints(side, *(_names(motion, indices) for indices in points))
    return None


def _ancestor(motion: PointMotion, elbow: int, own: _Named) -> int | None:
    """The nearest ancestor at another place; of two halves of an upper arm the upper one."""
    above = [i for i in _line(motion.parents, elbow) if _is_joint(motion, i) and _distance(motion, i, elbow) > 0]
    if not above:
        return None
    nearest = above[0]
    if nearest not in own or own[nearest].part != "upper_arm":
        return nearest
    halves = [i for i in above if i in own and own[i].part == "upper_arm"]
    return halves[-1]


def _line(parents: Sequence[int], index: int) -> list[int]:
    """The ancestors of a joint, the nearest first."""
    line = []
    while (index := parents[index]) >= 0:
        line.append(index)
    return line


def _is_joint(motion: PointMotion, index: int) -> bool:
    return not is_twist(motion.names[index])


def _first_below(motion: PointMotion, elbow: int, own: _Named) -> int | None:
    """The first descendant at another place, if possible one that is called wrist or hand."""
    below = [i for i in range(elbow + 1, len(motion.names)) if elbow in _line(motion.parents, i)]
    below = [i for i in below if _is_joint(motion, i) and not is_thumb(motion.names[i])]
    below = [i for i in below if _distance(motion, elbow, i) > 0]
    named = [i for i in below if i in own and own[i].part in ("wrist", "hand")]
    depth: Callable[[int], int] = lambda i: len(_line(motion.parents, i))  # noqa: E731
    return min(named or below, key=depth, default=None)


def _hand(motion: PointMotion, wrist: int, own: _Named, forearm: float) -> int | None:
    """The first descendant of the wrist that is neither too near nor, as a prop, too far away."""
    current = wrist
    while True:
        children = [i for i, parent in enumerate(motion.parents) if parent == current]
        children = [i for i in children if not is_thumb(motion.names[i]) and _is_joint(motion, i)]
        children = [i for i in children if _distance(motion, wrist, i) <= _LONG * forearm]
        if not children:
            return None
        fingers = [i for i in children if i in own and own[i].part in ("hand", "index")]
        current = (fingers or children)[0]
        if _distance(motion, wrist, current) > _SHORT * forearm:
            return current


def _distance(motion: PointMotion, first: int, second: int) -> float:
    """Median distance of two points, in the unit of the motion; 0 where they coincide."""
    median = median_length(motion.positions[:, first] - motion.positions[:, second])
    return median if median > 1e-9 else 0.0
