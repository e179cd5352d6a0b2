"""Recording demonstrations: an expert is driven to random goals, simulated by C MuJoCo.

The expert is controlled like the learner, by torques that are constant within a step, so that a learner of the same
embodiment can reproduce the motion exactly.
"""

import copy
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import Arm, finite_velocity_limit
from mimic.arms.embodiment import Embodiment
from mimic.base.config import check_choice
from mimic.motions.demonstrations import Demonstrations

KINDS = ("pd", "reach")
GOAL_SHARE = 0.5  # goals lie within this fraction of the way from the home pose to the joint limits
# Joint-space PD control: critically damped, at 2 rad/s. A goal that is pi/2 away needs a peak speed of 1.2 rad/s
# (omega * distance / e), within every joint's velocity limit, and is reached to within 1 % in 3.3 s of the 5 s.
PD_FREQUENCY = 2.0  # rad/s
REACH_FRACTION = 0.6  # fraction of an episode after which the expert has reached its goal and stays there
REACH_FREQUENCY = 4.0  # rad/s, of the feedback that tracks the joint path of the reach
_REACH_SPEED_FRACTION = 0.9  # of the velocity limit, for inverse kinematics; the feedback needs the rest
_REACH_DAMPING = 1e-2  # regularises inverse kinematics near the stretched arm, a singularity where episodes start
_MAX_DRAWS = 100

# (time [s], joint angles, joint velocities) -> desired joint accelerations
_Control = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


# Above 40 lines because of its docstring.
def record_demonstrations(
    arm: Arm,
    count: int,
    *,
    kind: str = "pd",
    seed: int = 0,
    horizon: int = 50,
    dt: float = 0.1,
    substeps: int = 10,
    on_recorded: Callable[[int], None] = lambda redrawn: None,
) -> Demonstrations:
    """Records an expert that moves to random goals (paper, "Dynamic Motion Imitation").

    Every trajectory starts at rest in the home pose. A goal is redrawn if the arm would exceed a torque, velocity or
    joint limit on its way.

    Args:
      arm: the expert, from `build_arm`.
      count: number of demonstrations.
      kind: "pd", joint-space PD control to a random pose (paper), or "reach": the hand moves to its frame in a random
        pose, by inverse kinematics. The path is straight, except for the first moments in the stretched home pose,
        which is a singularity.
      seed: random seed; demonstration i of a kind and seed does not depend on the count.
      horizon: steps T of a demonstration.
      dt: control step [s].
      substeps: physics steps in a control step.
      on_recorded: called after each demonstration with the number of its goals that were redrawn.

    Raises:
      ValueError: an unknown kind, a count, horizon or time below its minimum, or an arm whose limits allow no goal.
    """
    check_choice("kind", kind, KINDS)
    for name, value in (("count", count), ("horizon", horizon), ("substeps", substeps)):
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    if not dt > 0:
        raise ValueError(f"dt: expected a time above 0 s, got {dt}")

    def record(index: int) -> tuple[tuple[np.ndarray, ...], int]:
        return _recording(arm, kind, np.random.default_rng([seed, index]), horizon, dt, substeps)

    recordings = []
    with ThreadPoolExecutor(os.cpu_count()) as executor:  # MuJoCo releases the GIL while it steps
        for recording, redrawn in executor.map(record, range(count)):
            recordings.append(recording)
            on_recorded(redrawn)
    qpos, qvel, torque, goals = (np.stack(column) for column in zip(*recordings, strict=True))
    embodiment = arm.embodiment
    return Demonstrations(qpos, qvel, goals, float(dt), embodiment.name, embodiment.joint_names, seed, torque)


def _recording(
    arm: Arm, kind: str, rng: np.random.Generator, horizon: int, dt: float, substeps: int
) -> tuple[tuple[np.ndarray, ...], int]:
    """Angles, velocities, torques and goal of a demonstration, and the number of goals that were redrawn."""
    embodiment = arm.embodiment
    home = np.asarray(embodiment.home)
    lower, upper = np.asarray(embodiment.joint_range).T
    make_control = {"pd": _pd_control, "reach": _reach_control}[kind]
    for redrawn in range(_MAX_DRAWS):
        goal = home + GOAL_SHARE * (rng.uniform(lower, upper) - home)
        trajectory = _simulate(arm, make_control(arm, goal, horizon, dt), horizon, dt, substeps)
        if trajectory is not None:
            return (*trajectory, goal), redrawn
    raise ValueError(f"demonstrations: {_MAX_DRAWS} random goals of {embodiment.name!r} all exceed its limits")


def _within_limits(arm: Embodiment, qpos: np.ndarray, qvel: np.ndarray, torque: np.ndarray) -> bool:
    lower, upper = np.asarray(arm.joint_range).T
    return bool(
        np.all(np.abs(torque) <= arm.torque_limit)
        and np.all(np.abs(qvel) <= arm.velocity_limit)
        and np.all((qpos >= lower) & (qpos <= upper))
    )


def _pd_control(arm: Arm, goal: np.ndarray, horizon: int, dt: float) -> _Control:
    del arm, horizon, dt
    return lambda time, qpos, qvel: PD_FREQUENCY**2 * (goal - qpos) - 2 * PD_FREQUENCY * qvel


def _reach_control(arm: Arm, goal: np.ndarray, horizon: int, dt: float) -> _Control:
    """Feedback control along the joint path that moves the hand to its frame in the pose `goal`."""
    path, path_velocity = _reach_path(arm, goal, horizon, dt)
    path_acceleration = np.diff(path_velocity, axis=0, append=path_velocity[-1:]) / dt

    def control(time: float, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        step = round(time / dt)
        position_error, velocity_error = path[step] - qpos, path_velocity[step] - qvel
        return path_acceleration[step] + REACH_FREQUENCY**2 * position_error + 2 * REACH_FREQUENCY * velocity_error

    return control


def _reach_path(
    arm: Arm, goal: np.ndarray, horizon: int, dt: float
) -> tuple[Float[np.ndarray, "samples joints"], Float[np.ndarray, "samples joints"]]:
    """Angles and velocities that move the last body along a line and the shortest rotation, with minimum jerk."""
    import mink  # takes half a second, and only this kind of demonstration needs it

    model, embodiment = arm.model, arm.embodiment
    hand = model.nbody - 1
    max_velocity = finite_velocity_limit(embodiment) * _REACH_SPEED_FRACTION
    limits = [mink.VelocityLimit(model, dict(zip(embodiment.joint_names, max_velocity, strict=True)))]
    configuration = mink.Configuration(model, np.asarray(embodiment.home, float))
    start = configuration.get_transform_frame_to_world(hand, "body")
    end = mink.Configuration(model, goal).get_transform_frame_to_world(hand, "body")
    task = mink.FrameTask(hand, "body", position_cost=1.0, orientation_cost=0.3)  # 0.3 m/rad: the reach of a hand
    path, path_velocity = [configuration.q.copy()], []
    for step in range(horizon):
        progress = min((step + 1) / (REACH_FRACTION * horizon), 1.0)
        task.set_target(start.interpolate(end, alpha=10 * progress**3 - 15 * progress**4 + 6 * progress**5))
        velocity = mink.solve_ik(configuration, [task], dt, solver="daqp", damping=_REACH_DAMPING, limits=limits)
        configuration.integrate_inplace(velocity, dt)
        path.append(configuration.q.copy())
        path_velocity.append(velocity)
    return np.stack(path), np.stack([*path_velocity, np.zeros_like(goal)])


def _simulate(
    arm: Arm, control: _Control, horizon: int, dt: float, substeps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Trajectory [T+1, n] and torques [T, n] under computed-torque control; None if the arm exceeds a limit."""
    model = copy.copy(arm.model)
    model.opt.timestep = dt / substeps
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # an automatic reset would hide divergence
    data = mujoco.MjData(model)
    data.qpos[:] = arm.embodiment.home
    inertial = np.zeros(model.nv)
    qpos, qvel, torques = [data.qpos.copy()], [data.qvel.copy()], []
    for step in range(horizon):
        mujoco.mj_forward(model, data)
        mujoco.mj_mulM(model, data, inertial, control(step * dt, data.qpos, data.qvel))
        data.qfrc_applied[:] = inertial + data.qfrc_bias - data.qfrc_passive
        torques.append(data.qfrc_applied.copy())
        mujoco.mj_step(model, data, substeps)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        if not _within_limits(arm.embodiment, qpos[-1], qvel[-1], torques[-1]):
            return None
    return np.stack(qpos), np.stack(qvel), np.stack(torques)
