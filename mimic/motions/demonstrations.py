"""Demonstrations: an expert's motions, saved in one npz file without pickle."""

import contextlib
import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import pose_limits
from mimic.base.npz import read_arrays

FORMAT = "mimic-demonstrations-1"
_IMPORT = "python -m mimic.demonstrations source=FILE out=NEW.npz imports motions of other formats"
_ARRAYS = ("qpos", "qvel", "goals", "dt", "seed", "arm", "joint_names", "format")
_OPTIONAL_ARRAYS = ("torque", "gripper", "gripper_names", "kinds")
_BY_MOTION = ("qpos", "qvel", "goals", "torque", "gripper")  # arrays with a row for each motion, the last two optional
CLIPS = "clips"  # kind of the motions of a file that does not say what drove them
MAX_VALUE = 1e6  # rad, rad/s, N m, s: no arm's motion has larger values
_STILL = 0.3  # probability that a joint of a smaller crossover stays at the start
_ROUNDING = 1e-6  # relative tolerance of a value above its limit: a file in float32 rounds by 6e-8
OVERSHOOT = 0.02  # rad, 1 degree: how far measured angles may lie beyond a joint's range
RECORDED_SPEED = 3.0  # times the model's velocity limit, which a recorded joint may have: some state 1 rad/s for all


@dataclasses.dataclass(frozen=True)
class Demonstrations:
    """Joint trajectories of an expert, each from time 0 to T dt.

    Attributes:
      qpos: [N, T+1, n] joint angles [rad].
      qvel: [N, T+1, n] joint velocities [rad/s].
      goals: [N, n] target poses of the expert's controller [rad].
      dt: time between two samples [s].
      arm: the expert's name.
      joint_names: the expert's joints, base to tip.
      seed: random seed of the goals.
      torque: [N, T, n] torque between each sample and the next [N m], without gravity compensation; None if unknown.
      gripper: [N, T+1, m] joints or opening of the gripper, in the units of their source; None if unknown.
      gripper_names: its channels.
      kinds: [N] what drove the expert, see `record_demonstrations`; "clips" for motions of a file that does not say.
    """

    qpos: Float[np.ndarray, "demonstrations samples joints"]
    qvel: Float[np.ndarray, "demonstrations samples joints"]
    goals: Float[np.ndarray, "demonstrations joints"]
    dt: float
    arm: str
    joint_names: tuple[str, ...]
    seed: int = 0
    torque: Float[np.ndarray, "demonstrations steps joints"] | None = None
    gripper: Float[np.ndarray, "demonstrations samples channels"] | None = None
    gripper_names: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.kinds:
            object.__setattr__(self, "kinds", (CLIPS,) * len(self.qpos))

    @property
    def count(self) -> int:
        """Number N of demonstrations."""
        return self.qpos.shape[0]

    @property
    def horizon(self) -> int:
        """Steps T of an episode."""
        return self.qpos.shape[1] - 1

    def select(self, index: slice | Sequence[int]) -> "Demonstrations":
        """The demonstrations with these indices."""
        arrays = {key: values[index] for key in _BY_MOTION if (values := getattr(self, key)) is not None}
        return dataclasses.replace(self, **arrays, kinds=tuple(map(str, np.array(self.kinds, dtype=str)[index])))

    def of_length(self, steps: int) -> "Demonstrations":
        """The demonstrations with another number of steps: shortened, or with the last sample repeated.

        Beyond a demonstration's end its last sample is imitated.
        """
        sample = np.minimum(np.arange(steps + 1), self.horizon)
        torque = None if self.torque is None or steps > self.horizon else self.torque[:, :steps]
        gripper = None if self.gripper is None else self.gripper[:, sample]
        return dataclasses.replace(
            self, qpos=self.qpos[:, sample], qvel=self.qvel[:, sample], torque=torque, gripper=gripper
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one `.npz` file; an existing file is replaced only when the new one is complete."""
        partial = f"{os.fspath(path)}.partial"
        content = {"format": FORMAT} | {key: value for key, value in vars(self).items() if value is not None}
        if self.gripper is None:
            del content["gripper_names"]
        with open(partial, "wb") as file:
            np.savez_compressed(file, **{key: np.asarray(value) for key, value in content.items()})  # type: ignore[arg-type]
        os.replace(partial, path)

    def check_fits(self, arm: Embodiment, dt: float, horizon: int) -> None:
        """Raises a ValueError unless arm, time step and length fit those of an environment."""
        if (self.arm, self.joint_names) != (arm.name, arm.joint_names):  # joint1, joint2, … are names in many arms
            expected, got = repr(arm.name), repr(self.arm)
            if self.joint_names != arm.joint_names:
                expected += f" with the joints {', '.join(arm.joint_names)}"
                got += f" with {', '.join(self.joint_names)}"
            raise ValueError(
                f"demonstrations: expected motions of the expert {expected}, got those of {got}; env.expert=ARM sets "
                "the expert of a new training"
            )
        if abs(self.dt - dt) > 1e-9:
            raise ValueError(f"demonstrations: expected a time step of {dt} s (env.control_dt), got {self.dt} s")
        if self.horizon < horizon:
            raise ValueError(f"demonstrations: expected {horizon} steps or more (env.horizon), got {self.horizon}")


def concatenate(first: Demonstrations, second: Demonstrations) -> Demonstrations:
    """Joins two sets of demonstrations of one arm and time step. Torques and grippers are kept if both have them."""
    joined: dict[str, Any] = {}
    for key in _BY_MOTION:
        parts = [getattr(first, key), getattr(second, key)]
        joined[key] = None if any(part is None for part in parts) else np.concatenate(parts)
    if first.gripper_names != second.gripper_names:
        joined["gripper"] = None
    names = () if joined["gripper"] is None else first.gripper_names
    return dataclasses.replace(first, **joined, gripper_names=names, kinds=first.kinds + second.kinds)


def check_effort(demonstrations: Demonstrations, arm: Embodiment, speed: float = 1.0) -> None:
    """Raises a ValueError if a joint exceeds its range or velocity limit, or its torque limit where torques are known.

    Measured angles may lie 0.02 rad beyond a range; a joint that can rotate by a full revolution has none.

    Args:
      demonstrations: of the arm.
      arm: whose limits are checked.
      speed: how many times its velocity limit a joint may have.

    Raises:
      ValueError: names the first demonstration above a limit, with joint, time, value and limit.
    """
    checks = [("velocity", demonstrations.qvel, "rad/s", arm.velocity_limit, speed)]
    if demonstrations.torque is not None:
        checks.append(("torque", demonstrations.torque, "N m", arm.torque_limit, 1.0))
    for quantity, values, unit, limit, times in checks:
        above_limit = np.argwhere(np.abs(values) > times * np.asarray(limit) * (1 + _ROUNDING))
        if len(above_limit):
            demonstration, sample, joint = above_limit[0]
            raise ValueError(
                f"demonstrations: {arm.joint_names[joint]} of demonstration {demonstration} has a {quantity} of "
                f"{values[demonstration, sample, joint]:.7g} {unit} at {sample * demonstrations.dt:.4g} s, "
                f"but its {quantity} limit is {limit[joint]:.7g} {unit}"
            )
    lower, upper = pose_limits(arm, float)
    outside = np.argwhere(np.maximum(lower - demonstrations.qpos, demonstrations.qpos - upper) > OVERSHOOT)
    if len(outside):
        demonstration, sample, joint = outside[0]
        raise ValueError(
            f"demonstrations: {arm.joint_names[joint]} of demonstration {demonstration} is at "
            f"{demonstrations.qpos[demonstration, sample, joint]:.4g} rad at {sample * demonstrations.dt:.4g} s, "
            f"but its range is {lower[joint]:.4g} to {upper[joint]:.4g} rad"
        )


def crossovers(
    demonstrations: Demonstrations,
    count: int,
    seed: int,
    displaced: float = 0.0,
    joint_range: Float[np.ndarray, "joints 2"] | None = None,
) -> Demonstrations:
    """Additional demonstrations, mixed from existing ones: each joint moves as in a random one of them.

    If the joints are controlled independently, as by joint-space PD control from one home pose, a mixed demonstration
    is what the expert would do for goals that are mixed in the same way. Otherwise it is at least smooth and within the
    joint ranges. Every fourth one is also smaller: its displacements from the start are multiplied by a random factor
    from 0 to 1, and each joint stays at the start with probability 0.3. Without these a policy is inexact where the
    expert moves little (docs/dynamic_imitation.md).

    Args:
      demonstrations: the existing demonstrations.
      count: number of additional demonstrations.
      seed: random seed of the mixing.
      displaced: fraction that is also displaced, each joint by a random constant that leaves it in its range, so that
        they start anywhere.
      joint_range: minimum and maximum angle of each joint [rad]; needed where any is displaced.
    """
    joints, rng = np.arange(len(demonstrations.joint_names)), np.random.default_rng(seed)
    parents = rng.integers(demonstrations.count, size=(count, len(joints)))
    qpos, qvel = (x.swapaxes(1, 2)[parents, joints].swapaxes(1, 2) for x in (demonstrations.qpos, demonstrations.qvel))
    goals = demonstrations.goals[parents, joints]
    moves = rng.uniform(size=parents.shape) > _STILL
    less = np.where(np.arange(count)[:, None] % 4 == 3, 1 - rng.uniform(size=(count, 1)) * moves, 0.0)
    start = qpos[:, 0]
    qpos, goals = qpos - less[:, None] * (qpos - start[:, None]), goals - less * (goals - start)
    if displaced:
        assert joint_range is not None
        down, up = joint_range[:, 0] - qpos.min(axis=1), joint_range[:, 1] - qpos.max(axis=1)
        offset = rng.uniform(np.minimum(down, 0), np.maximum(up, 0)) * (rng.uniform(size=(count, 1)) < displaced)
        qpos, goals = qpos + offset[:, None], goals + offset
    mixed: dict[str, Any] = {"qpos": qpos, "qvel": qvel - less[:, None] * qvel, "goals": goals}
    return dataclasses.replace(
        demonstrations, torque=None, gripper=None, gripper_names=(), kinds=("crossover",) * count, **mixed
    )


def effective_rank(demonstrations: Demonstrations) -> float:
    """Number of independent courses of time in the motions, from 1 to T: the exponential of an entropy.

    The courses are the right singular vectors of the joints' displacements over time [N n, T]; the entropy is that of
    their fractions of the energy, the squared singular values (Roy and Vetterli, "The effective rank", 2007). Linear
    feedback to one goal has about 1.
    """
    displacements = (demonstrations.qpos - demonstrations.qpos[:, :1])[:, 1:].swapaxes(1, 2)
    values = np.linalg.svd(displacements.reshape(-1, demonstrations.horizon), compute_uv=False) ** 2
    fractions = values[values > 0] / values.sum()
    return float(np.exp(-np.sum(fractions * np.log(fractions))))


def is_demonstrations(path: str | os.PathLike[str]) -> bool:
    """Whether a path is that of a file in the format of `Demonstrations.save`."""
    if os.fspath(path).endswith(".npz") and os.path.isfile(path):
        with contextlib.suppress(ValueError):  # not an npz file
            return str(read_arrays(path, ["format"]).get("format")) == FORMAT
    return False


def load_demonstrations(path: str | os.PathLike[str]) -> Demonstrations:
    """Reads and validates a file of demonstrations, in the format of `Demonstrations.save`.

    Raises:
      ValueError: the file is missing or what `read_arrays` rejects, lacks an array, or has arrays of wrong shape or
        with values that are not finite or above 1e6.
    """
    name = os.fspath(path)
    if not os.path.isfile(path):
        what = f"{name!r} is a folder; {_IMPORT}" if os.path.isdir(path) else f"no file at {name!r}"
        raise ValueError(f"demonstrations: {what}")
    advice = "" if name.lower().endswith(".npz") else f"; {_IMPORT}"
    try:
        content = read_arrays(path, (*_ARRAYS, *_OPTIONAL_ARRAYS))
        missing = [key for key in _ARRAYS if key not in content]
        if missing:
            advice = f"; {_IMPORT}" if "format" in missing else advice
            raise ValueError(f"it lacks {', '.join(missing)}; expected are {', '.join(_ARRAYS)}")
    except ValueError as error:
        reason = f"is not a complete npz file of demonstrations: {error}{advice}"
        raise ValueError(f"demonstrations: {name!r} {reason}") from error
    if str(content["format"]) != FORMAT:
        raise ValueError(f"demonstrations: {name!r} has format {str(content['format'])!r}, expected {FORMAT!r}")
    return _validated(content, name)


def _validated(content: dict[str, np.ndarray], name: str) -> Demonstrations:
    joint_names = tuple(map(str, np.atleast_1d(content["joint_names"])))
    _check_trajectories(content, name, len(joint_names))
    for key in ("dt", "seed", "arm"):
        if content[key].shape != ():
            raise ValueError(f"demonstrations: {key} in {name!r} must be one value, got shape {content[key].shape}")
    if not np.issubdtype(content["seed"].dtype, np.integer):
        raise ValueError(f"demonstrations: seed in {name!r} must be an integer, got {content['seed'].dtype}")
    if "kinds" in content and content["kinds"].shape != content["qpos"].shape[:1]:
        raise ValueError(
            f"demonstrations: kinds in {name!r} must have a name for each of {len(content['qpos'])} demonstrations, "
            f"got shape {list(content['kinds'].shape)}"
        )
    if content["dt"] <= 0:
        raise ValueError(f"demonstrations: dt in {name!r} must be one number above 0, got {content['dt']}")
    return Demonstrations(
        qpos=content["qpos"],
        qvel=content["qvel"],
        goals=content["goals"],
        dt=float(content["dt"]),
        arm=str(content["arm"]),
        joint_names=joint_names,
        seed=int(content["seed"]),
        torque=content.get("torque"),
        gripper=content.get("gripper"),
        gripper_names=tuple(map(str, np.atleast_1d(content.get("gripper_names", ())))),
        kinds=tuple(map(str, content["kinds"])) if "kinds" in content else (),
    )


def _check_trajectories(content: dict[str, np.ndarray], name: str, joints: int) -> None:
    """Checks type, values and shapes of the numeric arrays."""
    qpos, qvel, goals, torque = content["qpos"], content["qvel"], content["goals"], content.get("torque")
    numeric = {key: content[key] for key in ("qpos", "qvel", "goals", "dt", "torque", "gripper") if key in content}
    for key, array in numeric.items():
        if not np.issubdtype(array.dtype, np.floating):
            raise ValueError(f"demonstrations: {key} in {name!r} must be floating point, got {array.dtype}")
        if not np.all(np.isfinite(array)):
            raise ValueError(f"demonstrations: {key} in {name!r} has values that are not finite")
        if float(np.abs(array).max(initial=0)) > MAX_VALUE:
            raise ValueError(f"demonstrations: {key} in {name!r} has values above {MAX_VALUE:g}, which no arm has")
    if qpos.ndim != 3 or qpos.shape[0] < 1 or qpos.shape[1] < 2 or qpos.shape[2] != joints:
        raise ValueError(
            f"demonstrations: qpos in {name!r} must be [demonstrations, samples >= 2, {joints} joints], "
            f"got {list(qpos.shape)}"
        )
    if qvel.shape != qpos.shape or goals.shape != (qpos.shape[0], qpos.shape[2]):
        raise ValueError(
            f"demonstrations: qvel and goals in {name!r} must be {list(qpos.shape)} and "
            f"{[qpos.shape[0], qpos.shape[2]]}, got {list(qvel.shape)} and {list(goals.shape)}"
        )
    steps = [qpos.shape[0], qpos.shape[1] - 1, qpos.shape[2]]
    if torque is not None and list(torque.shape) != steps:
        raise ValueError(f"demonstrations: torque in {name!r} must be {steps}, got {list(torque.shape)}")
    channels = [*qpos.shape[:2], np.size(content.get("gripper_names", ()))]
    if "gripper" in content and list(content["gripper"].shape) != channels:
        raise ValueError(
            f"demonstrations: gripper in {name!r} must be {channels}, got {list(content['gripper'].shape)}"
        )
