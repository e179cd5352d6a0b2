"""What looks wrong with joint angles, beside what their source says of them otherwise, and what would mend it.

Where errors are large, they are computed for angles with one sign changed, two joints
exchanged, or one zero shifted, and for the best of these again, until the errors are small: so that a user reads not
only that something is wrong, but what.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.motions.evidence import RELATIVE, VELOCITIES, Evidence, Samples, evidence_of, samples_of
from mimic.motions.formats.episodes import Motion

_SHIFTS = np.radians([5, 15, 30, 60, 90, -5, -15, -30, -60, -90, 180])  # of zeros, which are refined
_REFINEMENTS, _NARROWER = 5, 0.2  # rounds, and the factor of the shifts from one to the next
_CHANGES = 6  # at most
_LOWER, _MUCH_LOWER = 0.8, 0.3  # fractions of the mean error to which a change lowers it; the latter within tolerance
_EQUAL = 1.01  # times the least error: a changed sign then counts before the zeros that do the same, 180 deg off
_STILL, _MOVES = 1e-4, 0.05  # rad: a joint that stands still, and one that moves
_OTHER_RATE, _MAX_RATIO = 1.25, 100.0  # of stated velocities and those of the angles


class Change(NamedTuple):
    """Angles as they would be otherwise: sign * angles[order] + shift, joint by joint."""

    sign: Float[np.ndarray, " joints"]
    order: tuple[int, ...]
    shift: Float[np.ndarray, " joints"]

    def of(self, qpos: Float[np.ndarray, "*rows joints"]) -> Float[np.ndarray, "*rows joints"]:
        """The changed angles."""
        return self.sign * qpos[..., list(self.order)] + self.shift


def doubts(
    arm: Embodiment,
    motions: Mapping[str, Motion],
    commands: Mapping[str, Mapping[str, Motion]],
    source_names: Sequence[str],
) -> list[str]:
    """Warnings about angles that are not what their source says of them otherwise; none where all agree.

    Args:
      arm: whose joints the motions move.
      motions: as measured, by name [rad].
      commands: the commanded ones, by entry.
      source_names: names of the joints in the source, base to tip.
    """
    samples = samples_of(motions)
    if len(samples.rows) < 3:
        return []
    found: dict[str, list[str]] = {}
    frozen = _frozen(arm, samples, motions, commands)
    lines = list(frozen)
    for evidence in evidence_of(arm, samples, motions, commands):
        if evidence.is_weak and (lines or found):
            continue
        if line := _other_times(evidence):
            lines.append(line)
            continue
        changes, error, before = explain(evidence, arm.num_joints, 0 if frozen else _CHANGES)
        if np.all(before <= evidence.tolerance):
            continue
        if np.all(error <= evidence.tolerance) and not frozen:
            for text in _texts(changes, arm.joint_names, source_names):
                found.setdefault(text, []).append(evidence.name)
        else:
            part = int(np.argmax(before))
            joint = f" of {arm.joint_names[part]}" if len(before) > 1 else ""
            lines.append(
                f"the angles{joint} do not fit {evidence.name}: an error of {before[part]:.3g}{evidence.unit}"
                + ", which no sign, zero or exchange of joints mends; another arm, other units or times?" * (not frozen)
            )
    lines += [f"{text}, beside {' and '.join(names)}" for text, names in found.items()]
    return [f"warning: {line}" for line in lines]


def explain(evidence: Evidence, joints: int, most: int = _CHANGES) -> tuple[list[Change], np.ndarray, np.ndarray]:
    """The changes, at most so many, that lower the errors most; the errors [parts] then, and before."""
    none = Change(np.ones(joints), tuple(range(joints)), np.zeros(joints))
    changes: list[Change] = []
    rows, error = evidence.rows, evidence.errors(evidence.rows[None])[0]
    before = error
    while np.any(before > evidence.tolerance) and len(changes) < most:
        candidates = list(_candidates(none, evidence.has_zeros))
        change = _best(evidence, rows, candidates, _EQUAL)
        direction, width = np.sign(np.abs(change.shift)), np.abs(change.shift).max()
        for _ in range(_REFINEMENTS if width else 0):
            shifts = change.shift + width * np.linspace(-1, 1, 11)[:, None] * direction
            change, width = _best(evidence, rows, [change._replace(shift=x) for x in shifts]), _NARROWER * width
        after = evidence.errors(change.of(rows)[None])[0]
        is_explained = np.all(error <= evidence.tolerance)
        if after.mean() > (_MUCH_LOWER if is_explained else _LOWER) * error.mean():
            break
        changes, rows, error = [*changes, change], change.of(rows), after
    return changes, error, before


def _best(evidence: Evidence, rows: np.ndarray, candidates: Sequence[Change], equal: float = 1.0) -> Change:
    """The first change of those whose error is at most `equal` times the least."""
    errors = evidence.errors(np.stack([change.of(rows) for change in candidates])).mean(axis=1)
    return candidates[int(np.argmax(errors <= equal * errors.min()))]


def _candidates(none: Change, has_zeros: bool) -> Iterator[Change]:
    """One changed sign or all, two exchanged joints, or one shifted zero."""
    yield none._replace(sign=-none.sign)
    joints = range(len(none.order))
    units = np.eye(len(joints))
    for joint in joints:
        yield none._replace(sign=none.sign - 2 * units[joint])
        for other in joints[joint + 1 :]:
            order = list(none.order)
            order[joint], order[other] = other, joint
            yield none._replace(order=tuple(order))
    if has_zeros:
        yield from (none._replace(shift=shift * unit) for unit in units for shift in _SHIFTS)


def _texts(changes: Sequence[Change], names: Sequence[str], source_names: Sequence[str]) -> Iterator[str]:
    """What the changes say of a source."""
    order = list(range(len(names)))
    for change in changes:
        order = [order[index] for index in change.order]
        if negated := [names[joint] for joint in np.flatnonzero(change.sign < 0).tolist()]:
            yield f"{', '.join(negated)} look{'s' * (len(negated) == 1)} negated"
        for joint in np.flatnonzero(change.shift).tolist():
            yield f"the zero of {names[joint]} looks {(180 - np.degrees(change.shift[joint])) % 360 - 180:.3g} deg off"
    if exchanged := [names[joint] for joint, index in enumerate(order) if index != joint]:
        listed = ",".join(str(source_names[index]) for index in order)
        yield f"{', '.join(exchanged)} look exchanged (joints=[{listed}] mends it)"


def _frozen(
    arm: Embodiment,
    samples: Samples,
    motions: Mapping[str, Motion],
    commands: Mapping[str, Mapping[str, Motion]],
) -> list[str]:
    """Lines about joints that never move while others do."""
    moved = np.ptp(samples.qpos, axis=0)
    lines = []
    for joint in np.flatnonzero(moved < _STILL).tolist() if moved.max() > _MOVES else ():
        line = f"{arm.joint_names[joint]} never moves, at {samples.qpos[0, joint]:.4g} rad"
        for entry, found in commands.items():
            goal = np.ptp(np.concatenate([found[name].qpos for name in motions])[:, joint])
            line += f", though {entry} moves it by {goal:.2g} rad" * bool(goal > _MOVES)
        lines.append(f"{line}: right where it was held, else its column is frozen")
    return lines


def _other_times(evidence: Evidence) -> str:
    """A line where velocities are those of the angles at another rate; empty elsewhere."""
    if evidence.name != VELOCITIES:
        return ""
    ratios = np.geomspace(1 / _MAX_RATIO, _MAX_RATIO, 201)
    errors = evidence.errors(ratios[:, None, None] * evidence.rows)
    ratio, error = ratios[int(errors.mean(axis=1).argmin())], errors.mean(axis=1).min()
    if max(ratio, 1 / ratio) < _OTHER_RATE or error > RELATIVE / 2:
        return ""
    return (
        f"the velocities are {ratio:.3g} times those of the angles and times: another rate (rate= or fps), or other "
        "units of one"
    )
