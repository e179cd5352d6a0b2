"""Controller bundles: the folders that hold a policy, its safety layer's clearance, its parameters and motions."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.base.files import file_digest, read_json
from mimic.base.npz import read_arrays
from mimic.control.clearance import ClearanceConstants, clearance
from mimic.control.joint_control import MODES, PERIOD, JointParameters
from mimic.control.limits import JointLimits

FORMAT = 4
POLICY = "policy.onnx"
CLEARANCE, CONTROLLER, MOTIONS = "clearance.npz", "controller.json", "motions.npz"
_MODELS = POLICY, CLEARANCE
_KEYS = (
    "format", "mimic_version", "mode", "period", "control_dt", "joint_names", "start_pose", "limits", "parameters",
    "preview", "past_actions", "expert_numbers", "robot", "hashes",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Bundle:
    """A controller that was exported.

    Attributes:
      folder: where it is.
      robot: name of the robot's model.
      joint_names: base to tip.
      mode: of the inner loop, see `mimic.control`.
      control_dt: tick of the policy [s].
      start_pose: [joints] of the first motion [rad].
      limits: the manufacturer's.
      parameters: of the inner loop, [joints] each.
      preview: number of later ticks whose expert states the policy observes.
      past_actions: number of its own actions that the policy observes.
      expert_numbers: of the expert's link states at a tick.
      expert: [motions, ticks + 1, expert_numbers] the expert's link states at each tick.
      start_poses: [motions, joints] where each motion starts [rad].
      names: of the motions.
      clearance: the arm with its capsules.
    """

    folder: Path
    robot: str
    joint_names: tuple[str, ...]
    mode: str
    control_dt: float
    start_pose: np.ndarray
    limits: JointLimits
    parameters: JointParameters
    preview: int
    past_actions: int
    expert_numbers: int
    expert: np.ndarray
    start_poses: np.ndarray
    names: tuple[str, ...]
    clearance: ClearanceConstants

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def ticks(self) -> int:
        """Ticks of a motion."""
        return self.expert.shape[1] - 1

    @property
    def periods(self) -> int:
        """Periods of the inner loop in a tick."""
        return round(self.control_dt / PERIOD)

    def clearance_of(self, qpos: np.ndarray) -> np.ndarray:
        """The clearance [rows] [m] of the arm in poses [rows, joints] [rad]; NaN where an angle is not finite."""
        with np.errstate(invalid="ignore"):
            return clearance(np.ascontiguousarray(qpos, np.float32), self.clearance)

    def motion_index(self, motion: int | str) -> int:
        """The index of a motion, by its name or its index.

        Raises:
          ValueError: there is no such motion.
        """
        if motion in self.names:
            return self.names.index(str(motion))
        if isinstance(motion, int) and 0 <= motion < len(self.expert):
            return motion
        raise ValueError(
            f"motion: expected a number from 0 to {len(self.expert) - 1} or a name such as {self.names[0]!r}, got "
            f"{motion!r:.80}"
        )


def write_bundle(
    folder: Path,
    *,
    policy: bytes,
    clearance: ClearanceConstants,
    controller: Mapping[str, Any],
    expert: np.ndarray,
    start_poses: np.ndarray,
    names: Sequence[str],
) -> None:
    """Writes a bundle into a new folder.

    Args:
      folder: must not exist.
      policy: ONNX model: the action, of measured and reference motions, past actions, and the expert's link states at a
        tick and the later ticks of the preview.
      controller: what `controller.json` has, without `format`, `period`, `start_pose` and `hashes`.
      clearance, expert, start_poses, names: see `Bundle`.
    """
    folder.mkdir()
    (folder / POLICY).write_bytes(policy)
    np.savez(folder / CLEARANCE, **clearance._asdict())
    content = {
        "format": FORMAT,
        **controller,
        "period": PERIOD,
        "start_pose": np.asarray(start_poses, float)[0].tolist(),
        "hashes": {name: file_digest(folder / name) for name in _MODELS},
    }
    np.savez(
        folder / MOTIONS,
        expert=np.asarray(expert, np.float32),
        start_poses=np.asarray(start_poses, float),
        names=np.asarray(names, str),
    )
    (folder / CONTROLLER).write_text(json.dumps(content, indent=2) + "\n")


def load_bundle(folder: str | Path) -> Bundle:
    """Reads a bundle and checks that its parts fit together.

    Raises:
      ValueError: a file is missing, damaged or of another version, or does not fit the others; in one line.
    """
    folder = Path(folder).expanduser()
    content = _controller(folder) if (folder / CONTROLLER).is_file() else {}
    missing = [name for name in (CONTROLLER, *_MODELS, MOTIONS) if not (folder / name).is_file()]
    if missing:
        raise ValueError(f"bundle: {str(folder)!r}: expected a folder of mimic.export with format=controller; it lacks "
                         f"{', '.join(missing)}")  # fmt: skip
    for name in _MODELS:
        if content["hashes"].get(name) != file_digest(folder / name):
            raise ValueError(f"bundle: {name}: expected the file that {CONTROLLER} was written for, got another one")
    motions = _arrays(folder / MOTIONS, ("expert", "start_poses", "names"))
    clearance = _arrays(folder / CLEARANCE, ClearanceConstants._fields)
    bundle = _parsed(folder, content, motions, clearance)
    _check(bundle)
    _check_clearance(bundle.clearance, bundle.num_joints)
    return bundle


def _controller(folder: Path) -> dict[str, Any]:
    try:
        keys = read_json(folder / CONTROLLER)
    except ValueError as error:
        raise ValueError(f"bundle: {CONTROLLER}: expected JSON: {error}") from error
    if keys.get("format", FORMAT) != FORMAT:
        raise ValueError(
            f"bundle: {CONTROLLER}: format: expected {FORMAT}, got {keys['format']!r:.40}; export the run again, with "
            "python -m mimic.export format=controller"
        )
    missing = [key for key in _KEYS if key not in keys]
    if missing:
        raise ValueError(f"bundle: {CONTROLLER}: expected the keys {', '.join(_KEYS)}; missing {', '.join(missing)}")
    if not isinstance(keys["hashes"], dict):
        raise ValueError(f"bundle: {CONTROLLER}: hashes: expected one for each file, got {keys['hashes']!r:.40}")
    return keys


def _arrays(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    try:
        arrays = read_arrays(path, names)
    except ValueError as error:
        raise ValueError(f"bundle: {path.name}: {error}") from error
    missing = [name for name in names if name not in arrays]
    if missing:
        raise ValueError(f"bundle: {path.name}: expected the arrays {', '.join(names)}; missing {', '.join(missing)}")
    return arrays


def _parsed(
    folder: Path, content: Mapping[str, Any], motions: Mapping[str, np.ndarray], clearance: Mapping[str, np.ndarray]
) -> Bundle:
    try:
        return Bundle(
            folder=folder,
            robot=str(content["robot"]),
            joint_names=tuple(content["joint_names"]),
            mode=content["mode"],
            control_dt=float(content["control_dt"]),
            start_pose=np.asarray(content["start_pose"], float),
            limits=JointLimits.from_lists(content["limits"]),
            parameters=JointParameters(
                *(np.asarray(content["parameters"][name], float) for name in JointParameters._fields)
            ),
            preview=int(content["preview"]),
            past_actions=int(content["past_actions"]),
            expert_numbers=int(content["expert_numbers"]),
            expert=np.asarray(motions["expert"], np.float32),
            start_poses=np.asarray(motions["start_poses"], float),
            names=tuple(str(name) for name in motions["names"]),
            clearance=ClearanceConstants(**clearance),
        )
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise ValueError(
            f"bundle: expected numbers and names of a controller, got an error in {error!r:.120}"
        ) from error


def _check(bundle: Bundle) -> None:
    """Raises a `ValueError` where parts of a bundle do not fit together."""
    if bundle.mode not in MODES:
        raise ValueError(f"bundle: mode: expected one of {', '.join(MODES)}, got {bundle.mode!r:.40}")
    periods = bundle.control_dt / PERIOD
    if not 1 <= periods < math.inf or abs(periods - bundle.periods) > 1e-6:
        raise ValueError(f"bundle: control_dt: expected a multiple of {PERIOD} s, got {bundle.control_dt}")
    if bundle.expert.ndim != 3:
        raise ValueError(f"bundle: expert: expected [motions, ticks + 1, numbers], got {bundle.expert.shape}")
    joints, motions = bundle.num_joints, len(bundle.expert)
    vectors = {"start_pose": bundle.start_pose, **bundle.parameters._asdict()}
    limits = {field.name: getattr(bundle.limits, field.name) for field in dataclasses.fields(bundle.limits)}
    shapes = {
        **{name: (value, (joints,)) for name, value in vectors.items()},
        **{
            f"limits.{name}": (value, (joints, 2) if name == "position" else (joints,))
            for name, value in limits.items()
        },
        "expert": (bundle.expert, (motions, bundle.ticks + 1, bundle.expert_numbers)),
        "start_poses": (bundle.start_poses, (motions, joints)),
        "names": (np.asarray(bundle.names), (motions,)),
    }
    for name, (value, shape) in shapes.items():
        if value.shape != shape or not motions:
            raise ValueError(f"bundle: {name}: expected the shape {shape} of {joints} joints, got {value.shape}")
        if value.dtype.kind == "f" and not np.all(np.isfinite(value)):
            raise ValueError(f"bundle: {name}: expected finite numbers")


def _check_clearance(arm: ClearanceConstants, joints: int) -> None:
    """Raises a `ValueError` where it is not an arm with this number of joints and something to check."""
    capsules, pairs, above = (np.asarray(x).shape[0] if np.ndim(x) else 0 for x in (arm.radius, arm.pairs, arm.above))
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("axis", "anchor"), (joints, 3))
    shapes |= {"parent": (joints,), **dict.fromkeys(("start", "end"), (capsules, 3))}
    shapes |= {"joint": (capsules,), "radius": (capsules,), "pairs": (pairs, 2), "above": (above,), "floor_height": ()}
    maximum = {"parent": joints, "joint": joints, "pairs": capsules, "above": capsules}  # of indices
    for name, values in arm._asdict().items():
        is_number = values.dtype.kind == ("i" if name in maximum else "f")
        if values.shape != shapes[name] or not is_number or not np.all(np.isfinite(values)):
            raise ValueError(
                f"bundle: {CLEARANCE}: {name}: expected finite numbers of the shape {shapes[name]} of {joints} joints, "
                f"got {values.shape}"
            )
        minimum = -1 if name in ("parent", "joint") else 0
        if name in maximum and not np.all((values >= minimum) & (values < maximum[name])):
            raise ValueError(f"bundle: {CLEARANCE}: {name}: expected indices from {minimum} to {maximum[name] - 1}")
    if np.any(arm.parent >= np.arange(joints)) or not pairs + above:
        raise ValueError(f"bundle: {CLEARANCE}: expected parents before their children, and something to check")
