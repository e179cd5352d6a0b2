"""Demonstrations: what the expert did, in one file without pickle. Recorded by `mimic.envs.recording`, or brought."""

import dataclasses
import os
import zipfile
import zlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mimic.embodiment import Embodiment

FORMAT = "mimic-demonstrations-1"
_ARRAYS = ("qpos", "qvel", "goals", "dt", "seed", "arm", "joint_names", "format")


@dataclasses.dataclass(frozen=True)
class Demonstrations:
    """Joint trajectories of an expert, each from time 0 to T dt.

    Attributes:
      qpos: [N, T+1, n] joint angles [rad].
      qvel: [N, T+1, n] joint velocities [rad/s].
      goals: [N, n] where the expert was told to go [rad].
      dt: time between two samples [s].
      arm: the expert's name.
      joint_names: the expert's joints, base to tip.
      seed: of the random goals.
    """

    qpos: Float[np.ndarray, "demonstrations samples joints"]
    qvel: Float[np.ndarray, "demonstrations samples joints"]
    goals: Float[np.ndarray, "demonstrations joints"]
    dt: float
    arm: str
    joint_names: tuple[str, ...]
    seed: int = 0

    @property
    def count(self) -> int:
        """How many there are."""
        return self.qpos.shape[0]

    @property
    def horizon(self) -> int:
        """Steps T of an episode."""
        return self.qpos.shape[1] - 1

    def select(self, index: slice | Sequence[int]) -> "Demonstrations":
        """Some of the demonstrations."""
        return dataclasses.replace(self, qpos=self.qpos[index], qvel=self.qvel[index], goals=self.goals[index])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one `.npz` file; a file of that name is replaced only when the new one is whole."""
        partial = f"{os.fspath(path)}.partial"
        with open(partial, "wb") as file:
            np.savez_compressed(
                file,
                format=np.array(FORMAT),
                qpos=self.qpos,
                qvel=self.qvel,
                goals=self.goals,
                dt=np.array(self.dt),
                seed=np.array(self.seed),
                arm=np.array(self.arm),
                joint_names=np.array(self.joint_names),
            )
        os.replace(partial, path)

    def check_fits(self, arm: Embodiment, dt: float, horizon: int) -> None:
        """Raises a ValueError unless an environment with this expert and time step can use these."""
        if (self.arm, self.joint_names) != (arm.name, arm.joint_names):  # joint1, joint2, … are names of many arms
            raise ValueError(
                f"demonstrations: recorded with the joints {', '.join(self.joint_names)} of {self.arm!r}, "
                f"but the expert {arm.name!r} has {', '.join(arm.joint_names)}"
            )
        if abs(self.dt - dt) > 1e-9:
            raise ValueError(
                f"demonstrations: recorded with a time step of {self.dt} s, but the environment has {dt} s"
            )
        if self.horizon < horizon:
            raise ValueError(
                f"demonstrations: {self.horizon} steps long, but an episode of the environment has {horizon}"
            )


def concatenate(first: Demonstrations, second: Demonstrations) -> Demonstrations:
    """The demonstrations of both, of one arm and time step."""
    join = {key: np.concatenate([getattr(first, key), getattr(second, key)]) for key in ("qpos", "qvel", "goals")}
    return dataclasses.replace(first, **join)


def crossovers(demonstrations: Demonstrations, count: int, seed: int) -> Demonstrations:
    """More demonstrations out of some: each joint moves as it does in a random one of them.

    Where joints are controlled apart from each other, as under joint-space PD control from one home pose, the result is
    what the expert would have shown for goals mixed in the same way. Else it is at least smooth, and within its range.

    Args:
      demonstrations: the given ones.
      count: how many to make.
      seed: of the choice.
    """
    joints = np.arange(len(demonstrations.joint_names))
    chosen = np.random.default_rng(seed).integers(demonstrations.count, size=(count, len(joints)))
    mixed = {
        "qpos": demonstrations.qpos.swapaxes(1, 2)[chosen, joints].swapaxes(1, 2),
        "qvel": demonstrations.qvel.swapaxes(1, 2)[chosen, joints].swapaxes(1, 2),
        "goals": demonstrations.goals[chosen, joints],
    }
    return dataclasses.replace(demonstrations, **mixed)


def load_demonstrations(path: str | os.PathLike[str]) -> Demonstrations:
    """Reads and validates a file that `Demonstrations.save` wrote, or one made like it.

    Raises:
      ValueError: the file is missing, truncated, no npz, holds pickled objects, lacks an array, or holds wrong shapes
        or values that are not finite.
    """
    name = os.fspath(path)
    if not os.path.isfile(path):
        raise ValueError(f"demonstrations: no file at {name!r}")
    try:
        archive = np.load(path, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        with archive:
            missing = [key for key in _ARRAYS if key not in archive.files]
            if missing:
                raise ValueError(f"it lacks {', '.join(missing)}; expected are {', '.join(_ARRAYS)}")
            content = {key: archive[key] for key in _ARRAYS}
    except (ValueError, OSError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        reason = "it holds pickled objects" if "allow_pickle" in str(error) else str(error)
        raise ValueError(f"demonstrations: {name!r} is not a whole npz file of demonstrations: {reason}") from error
    if str(content["format"]) != FORMAT:
        raise ValueError(f"demonstrations: {name!r} has format {str(content['format'])!r}, expected {FORMAT!r}")
    return _validated(content, name)


def _validated(content: dict[str, np.ndarray], name: str) -> Demonstrations:
    qpos, qvel, goals = content["qpos"], content["qvel"], content["goals"]
    joint_names = tuple(map(str, np.atleast_1d(content["joint_names"])))
    numeric = {key: content[key] for key in ("qpos", "qvel", "goals", "dt")}
    for key, array in numeric.items():
        if not np.issubdtype(array.dtype, np.floating):
            raise ValueError(f"demonstrations: {key} in {name!r} must be floating point, got {array.dtype}")
        if not np.all(np.isfinite(array)):
            raise ValueError(f"demonstrations: {key} in {name!r} has values that are not finite")
    if qpos.ndim != 3 or qpos.shape[0] < 1 or qpos.shape[1] < 2 or qpos.shape[2] != len(joint_names):
        raise ValueError(
            f"demonstrations: qpos in {name!r} must be [demonstrations, samples >= 2, {len(joint_names)} joints], "
            f"got {list(qpos.shape)}"
        )
    if qvel.shape != qpos.shape or goals.shape != (qpos.shape[0], qpos.shape[2]):
        raise ValueError(
            f"demonstrations: qvel and goals in {name!r} must be {list(qpos.shape)} and "
            f"{[qpos.shape[0], qpos.shape[2]]}, got {list(qvel.shape)} and {list(goals.shape)}"
        )
    for key in ("dt", "seed", "arm"):
        if content[key].shape != ():
            raise ValueError(f"demonstrations: {key} in {name!r} must be one value, got shape {content[key].shape}")
    if not np.issubdtype(content["seed"].dtype, np.integer):
        raise ValueError(f"demonstrations: seed in {name!r} must be an integer, got {content['seed'].dtype}")
    if content["dt"] <= 0:
        raise ValueError(f"demonstrations: dt in {name!r} must be one number above 0, got {content['dt']}")
    return Demonstrations(
        qpos=qpos,
        qvel=qvel,
        goals=goals,
        dt=float(content["dt"]),
        arm=str(content["arm"]),
        joint_names=joint_names,
        seed=int(content["seed"]),
    )
