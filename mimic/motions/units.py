"""Units of recorded angles: stated, found, or a question to the user; and their conversion to rad."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mimic.base.config import check_choice
from mimic.motions.cleaning import FULL_TURN
from mimic.motions.formats.episodes import Motion, Recording

UNITS = ("rad", "deg", "percent")
_SCALE = {"rad": 1.0, "deg": np.pi / 180}  # rad
_SLACK = 0.35  # rad, 20 degrees: angles further beyond a joint's range are no angles in this unit
_MAX_TURNS = 2  # of joints that turn on
_REACH = 100.5  # percent: LeRobot cuts its own at 100
_SMALLEST = 2.0  # deg or percent: recordings in which no joint moves further are in rad
_SMALL = 2 * np.pi  # the same for robots of which nothing says that they record degrees or percent
# What LeRobot's own robots with servos record is degrees, or percent of each joint's range: their `use_degrees`.
_SERVO_ROBOTS = ("so100", "so101", "so10", "so_", "bi_so", "koch", "lekiwi", "omx", "moss", "xlerobot", "bi_koch")
_SERVO_STEPS = (180 / 4095, 180 / 2048)  # deg: half a step of such servos, as LeRobot converts them


def find_unit(
    path: str, recording: Recording, joint_names: Sequence[str], joint_range: Float[np.ndarray, "joints 2"], units: str
) -> tuple[str, str]:
    """The unit of a recording's angles, and a line that says how it is known; empty where it is what a source states.

    Stated units count. Sources for which other units than rad are unusual are in rad. Others are in the only unit in
    which their values are angles of this arm and motions of more than 2 degrees.

    Args:
      path: of the source, for messages.
      recording: its angles as the source has them.
      joint_names: for messages.
      joint_range: of the arm's own model [rad].
      units: what the user states; empty for nothing.

    Raises:
      ValueError: the values fit no unit, or several.
    """
    angles = np.concatenate([motion.qpos for motion in recording.motions.values()])
    if unknown := [joint_names[joint] for joint in np.flatnonzero(~np.isfinite(angles).any(axis=0)).tolist()]:
        raise ValueError(f"source: {path!r} has no number as angle of {', '.join(unknown)}")
    low, high = np.nanmin(angles, axis=0), np.nanmax(angles, axis=0)
    excursion, joint = float(np.max(high - low)), int(np.argmax(high - low))
    if units:
        check_choice("units", units, UNITS)
        small = units != "rad" and 0 < excursion < _SMALLEST
        return units, f"warning: no joint moves by more than {excursion:.2g} {units}; are they rad?" if small else ""
    if recording.unit:
        return recording.unit, ""
    if recording.robot is None:
        return "rad", "units: rad, as is usual for such sources; units= states others"
    fitting = {unit: line for unit in UNITS if (line := _fit(unit, low, high, joint_range, recording))}
    is_servo = recording.robot.lower().startswith(_SERVO_ROBOTS)
    if "rad" in fitting and excursion <= (_SMALLEST if is_servo else _SMALL):
        fitting = {"rad": fitting["rad"]}
    values = f"{joint_names[joint]} from {low[joint]:.4g} to {high[joint]:.4g}"
    if len(fitting) == 1:
        ((unit, line),) = fitting.items()
        return unit, f"units: {unit}, found from {values}{line}; units= states others"
    robot = f", its robot_type is {recording.robot!r}" if recording.robot else ""
    degrees = ", ".join({"deg": "degrees"}.get(unit, unit) for unit in fitting) or "none of rad, degrees and percent"
    raise ValueError(
        f"source: {path!r} does not state its units{robot}: {values} fits {degrees}; expected one of "
        f"{', '.join(f'units={unit}' for unit in fitting or UNITS)}"
    )


def _fit(unit: str, low: np.ndarray, high: np.ndarray, joint_range: np.ndarray, recording: Recording) -> str:
    """Why values may be in a unit, to append to a line; empty where they are not."""
    turns_on = np.ptp(joint_range, axis=1) >= FULL_TURN
    if unit == "percent":
        return ", as no other unit fits" * bool(
            not turns_on.any() and np.all(low >= -_REACH) and np.all(high <= _REACH) and not _in_servo_steps(recording)
        )
    full = 2 * np.pi * _MAX_TURNS
    lower = np.where(turns_on, -full, joint_range[:, 0] - _SLACK)
    upper = np.where(turns_on, full, joint_range[:, 1] + _SLACK)
    inside = np.all(low * _SCALE[unit] >= lower) and np.all(high * _SCALE[unit] <= upper)
    in_steps = unit == "deg" and _in_servo_steps(recording)
    return (", in steps of a servo" if in_steps else ", within the joint ranges") * bool(inside)


def _in_servo_steps(recording: Recording) -> bool:
    """Whether all angles are whole steps of a servo in degrees, which percents of a joint's range are not."""
    values = np.concatenate([motion.qpos for motion in recording.motions.values()])
    return any(np.all(np.abs(values / step - np.round(values / step)) < 1e-2) for step in _SERVO_STEPS)


def in_rad(recording: Recording, unit: str, joint_range: Float[np.ndarray, "joints 2"]) -> Recording:
    """The recording with angles in rad and velocities in rad/s. Percent are from -100 to 100 of each joint's range.

    Raises:
      ValueError: percent of a joint without a range.
    """
    scale, offset = _scale_and_offset(unit, joint_range)
    motions = {
        name: motion._replace(
            qpos=offset + scale * motion.qpos, qvel=None if motion.qvel is None else scale * motion.qvel
        )
        for name, motion in recording.motions.items()
    }
    return recording._replace(motions=motions, unit="rad")


def from_rad(motion: Motion, unit: str, joint_range: Float[np.ndarray, "joints 2"]) -> Motion:
    """The motion with angles from rad in a unit, and velocities in this unit per second; see `in_rad`."""
    scale, offset = _scale_and_offset(unit, joint_range)
    return motion._replace(
        qpos=(motion.qpos - offset) / scale, qvel=None if motion.qvel is None else motion.qvel / scale
    )


def _scale_and_offset(unit: str, joint_range: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What turns a unit into rad: the factor of each joint, and what is added then."""
    if unit != "percent":
        return np.full(len(joint_range), _SCALE[unit]), np.zeros(len(joint_range))
    if np.any(np.ptp(joint_range, axis=1) >= FULL_TURN):
        raise ValueError("units=percent: expected an arm whose joints all have limits, as with limits=hardware")
    return np.ptp(joint_range, axis=1) / 200, joint_range.mean(axis=1)
