"""Recording demonstrations: an expert is driven to random goals, simulated by C MuJoCo.

The expert is controlled like the learner, by torques that are constant within a step, so that a learner of the same
embodiment can reproduce the motion exactly.
"""

import copy
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import Arm
from mimic.base.config import check_choice
from mimic.motions.demonstrations import Demonstrations
from mimic.motions.experts import KINDS, MIXED, Law, inverse_dynamics, kind_of, make_expert

_MAX_DRAWS = 100
_THREADS = 4  # at most; on 16 cores 16 threads take 1.4 times as long, because they wait for the GIL
_TEST = 1  # of `numpy.random.SeedSequence`: no other set has this spawn key


# Above 40 lines because of its docstring.
def record_demonstrations(
    arm: Arm,
    count: int,
    *,
    kind: str = MIXED,
    seed: int = 0,
    horizon: int = 50,
    dt: float = 0.1,
    substeps: int = 10,
    max_acceleration: Float[np.ndarray, " joints"] | None = None,
    test: bool = False,
    on_recorded: Callable[[int], None] = lambda redrawn: None,
) -> Demonstrations:
    """Records an expert that moves to random goals (paper, "Dynamic Motion Imitation").

    Every trajectory starts at rest in the home pose. A goal is redrawn if the arm would exceed a limit of torque,
    velocity, acceleration or angle on its way.

    Args:
      arm: the expert, from `build_arm`.
      count: number of demonstrations.
      kind: what drives the expert:
        "computed_torque": linear feedback to a random pose through exact inverse dynamics, at 2 rad/s.
        "pid": a PID controller for each joint to a random pose, without a model of the arm (paper).
        "reach": the hand moves to its frame in a random pose, by inverse kinematics. The path is straight, except for
        the first moments in the stretched home pose, which is a singularity.
        "splines": through several random poses, with rests and reversals, slowly or fast.
        "steps": as "computed_torque", to a pose that changes every 1.5 to 3 s.
        "mixed": each of these in turn.
      seed: random seed; demonstration i of a kind and seed does not depend on the count.
      horizon: steps T of a demonstration.
      dt: control step [s].
      substeps: physics steps in a control step.
      max_acceleration: limit of the mean acceleration in a control step [rad/s^2]; None where there is none.
      test: draw from seeds that no set for training or validation has.
      on_recorded: called after each demonstration with the number of its goals that were redrawn.

    Raises:
      ValueError: an embodiment in place of an arm, an unknown kind, a count, horizon or time below its minimum, or an
        arm whose limits allow no goal.
    """
    if not isinstance(arm, Arm):  # an embodiment has no dynamics
        raise ValueError(f"arm: expected an Arm, as of build_arm(ArmConfig()), got {type(arm).__name__}")
    check_choice("kind", kind, (*KINDS, MIXED))
    for name, value in (("count", count), ("horizon", horizon), ("substeps", substeps)):
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    if not dt > 0:
        raise ValueError(f"dt: expected a time above 0 s, got {dt}")
    kinds = [kind_of(kind, index) for index in range(count)]
    limits = _Limits(arm, max_acceleration, dt)

    def record(index: int) -> tuple[tuple[np.ndarray, ...], int]:
        # Unlike a longer list of numbers, a spawn key cannot give the random numbers of another seed.
        entropy = np.random.SeedSequence([seed, index], spawn_key=(_TEST,)) if test else [seed, index]
        return _recording(arm, kinds[index], np.random.default_rng(entropy), horizon, dt, substeps, limits)

    recordings = []
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as executor:  # MuJoCo releases the GIL while it steps
        for recording, redrawn in executor.map(record, range(count)):
            recordings.append(recording)
            on_recorded(redrawn)
    qpos, qvel, torque, goals = (np.stack(column) for column in zip(*recordings, strict=True))
    embodiment = arm.embodiment
    names = embodiment.name, embodiment.joint_names
    return Demonstrations(qpos, qvel, goals, float(dt), *names, seed, torque, kinds=tuple(kinds))


def _recording(
    arm: Arm,
    kind: str,
    rng: np.random.Generator,
    horizon: int,
    dt: float,
    substeps: int,
    limits: "_Limits",
) -> tuple[tuple[np.ndarray, ...], int]:
    """Angles, velocities, torques and goal of a demonstration, and the number of goals that were redrawn."""
    for redrawn in range(_MAX_DRAWS):
        expert = make_expert(kind, arm, rng, horizon, dt)
        trajectory = _simulate(arm, expert.law, horizon, dt, substeps, limits)
        if trajectory is not None:
            return (*trajectory, expert.goal), redrawn
    raise ValueError(f"demonstrations: {_MAX_DRAWS} random goals of {arm.embodiment.name!r} ({kind}) all exceed its "
                     "limits")  # fmt: skip


class _Limits:
    """The limits of an arm that a demonstration keeps."""

    def __init__(self, arm: Arm, max_acceleration: np.ndarray | None, dt: float):
        embodiment = arm.embodiment
        self._lower, self._upper = np.asarray(embodiment.joint_range).T
        self._velocity, self._torque = np.asarray(embodiment.velocity_limit), np.asarray(embodiment.torque_limit)
        self._change = np.inf if max_acceleration is None else np.asarray(max_acceleration) * dt

    def allow(self, qpos: Sequence[np.ndarray], qvel: Sequence[np.ndarray], torque: Sequence[np.ndarray]) -> bool:
        """Whether the last step of a trajectory is within the limits."""
        return bool(
            np.all(np.abs(torque[-1]) <= self._torque)
            and np.all(np.abs(qvel[-1]) <= self._velocity)
            and np.all(np.abs(qvel[-1] - qvel[-2]) <= self._change)
            and np.all((qpos[-1] >= self._lower) & (qpos[-1] <= self._upper))
        )


def _simulate(
    arm: Arm, law: Law, horizon: int, dt: float, substeps: int, limits: _Limits
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Trajectory [T+1, n] and torques [T, n]; None if the arm exceeds a limit."""
    model = copy.copy(arm.model)
    model.opt.timestep = dt / substeps
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # an automatic reset would hide divergence
    data = mujoco.MjData(model)
    data.qpos[:] = arm.embodiment.home
    inverse = inverse_dynamics(model, data)
    qpos, qvel, torques = [data.qpos.copy()], [data.qvel.copy()], []
    for step in range(horizon):
        mujoco.mj_forward(model, data)
        data.qfrc_applied[:] = law(step, data.qpos, data.qvel, inverse)
        torques.append(data.qfrc_applied.copy())
        mujoco.mj_step(model, data, substeps)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        if not limits.allow(qpos, qvel, torques):
            return None
    return np.stack(qpos), np.stack(qvel), np.stack(torques)
