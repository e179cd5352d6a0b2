"""Recording demonstrations: an expert that is driven to random goals, on C MuJoCo.

The expert is controlled as the learner will be, by torques that are held within a step: an equal arm can do just the
same.
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
from mimic.envs.demonstrations import Demonstrations

KINDS = ("pd", "reach")
GOAL_SHARE = 0.5  # goals lie within this share of the way from home to the joint limits
# Joint-space PD control: critically damped, at 2 rad/s. A goal a quarter turn away asks for a peak speed of 1.2 rad/s
# (omega * distance / e), within every joint's rating, and is reached to within 1 % in 3.3 s of the 5 s.
PD_FREQUENCY = 2.0  # rad/s
REACH_SHARE = 0.6  # of an episode; then the expert stays at its goal
REACH_FREQUENCY = 4.0  # rad/s, of the feedback that keeps the arm on its reach
_REACH_SPEED_SHARE = 0.9  # of the rated speed that the inverse kinematics may ask for; the feedback needs the rest
_REACH_DAMPING = 1e-2  # keeps inverse kinematics calm near the stretched arm, a singularity that episodes start in
_MAX_DRAWS = 100

# Desired joint acceleration at a time [s], from joint angles and velocities.
_Control = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


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
    """Records an expert on its way to random goals (paper, "Dynamic Motion Imitation").

    Every trajectory starts at rest in the home pose. Goals that would take the arm beyond a torque, speed or joint
    limit are drawn anew.

    Args:
      arm: the expert, from `build_arm`.
      count: number of demonstrations.
      kind: "pd", joint-space PD control to a random pose (paper), or "reach", the hand goes to where it is in a random
        pose, by inverse kinematics: straight, but for the first moments from the stretched home pose, a singularity.
      seed: demonstration i of a kind and seed is the same whatever the count.
      horizon: steps T of a demonstration.
      dt: control step [s].
      substeps: physics steps in a control step.
      on_recorded: called after each demonstration with the number of its goals that were drawn anew.

    Raises:
      ValueError: an unknown kind, a count, horizon or time below its least value, or an arm whose limits leave no goal.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    for name, value, least in (("count", count, 1), ("horizon", horizon, 1), ("substeps", substeps, 1)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
    if not dt > 0:
        raise ValueError(f"dt: expected a time above 0 s, got {dt}")

    def record(index: int) -> tuple[tuple[np.ndarray, ...], int]:
        return _record_one(arm, kind, np.random.default_rng([seed, index]), horizon, dt, substeps)

    recordings = []
    with ThreadPoolExecutor(os.cpu_count()) as executor:  # MuJoCo leaves Python to the others while it steps
        for recording, redrawn in executor.map(record, range(count)):
            recordings.append(recording)
            on_recorded(redrawn)
    qpos, qvel, torque, goals = (np.stack(column) for column in zip(*recordings, strict=True))
    embodiment = arm.embodiment
    return Demonstrations(qpos, qvel, goals, float(dt), embodiment.name, embodiment.joint_names, seed, torque)


def _record_one(
    arm: Arm, kind: str, rng: np.random.Generator, horizon: int, dt: float, substeps: int
) -> tuple[tuple[np.ndarray, ...], int]:
    """Angles, velocities, torques and goal of a demonstration, and how many goals before it broke limits."""
    embodiment = arm.embodiment
    home = np.asarray(embodiment.home)
    lower, upper = np.asarray(embodiment.joint_range).T
    make_control = {"pd": _pd_control, "reach": _reach_control}[kind]
    for redrawn in range(_MAX_DRAWS):
        goal = home + GOAL_SHARE * (rng.uniform(lower, upper) - home)
        trajectory = _simulate(arm, make_control(arm, goal, horizon, dt), horizon, dt, substeps)
        if trajectory is not None:
            return (*trajectory, goal), redrawn
    raise ValueError(f"demonstrations: {_MAX_DRAWS} random goals of {embodiment.name!r} all break its limits")


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
    """Feedback onto the joint path that takes the hand to where it is in the pose `goal`."""
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
    """Angles and velocities that move the last body's frame along a line and the shortest turn, with least jerk."""
    import mink  # half a second, and few need it

    model, embodiment = arm.model, arm.embodiment
    hand = model.nbody - 1
    rated = finite_velocity_limit(embodiment) * _REACH_SPEED_SHARE
    limits = [mink.VelocityLimit(model, dict(zip(embodiment.joint_names, rated, strict=True)))]
    configuration = mink.Configuration(model, np.asarray(embodiment.home, float))
    start = configuration.get_transform_frame_to_world(hand, "body")
    end = mink.Configuration(model, goal).get_transform_frame_to_world(hand, "body")
    task = mink.FrameTask(hand, "body", position_cost=1.0, orientation_cost=0.3)  # 0.3 m/rad: the reach of a hand
    path, path_velocity = [configuration.q.copy()], []
    for step in range(horizon):
        share = min((step + 1) / (REACH_SHARE * horizon), 1.0)
        task.set_target(start.interpolate(end, alpha=10 * share**3 - 15 * share**4 + 6 * share**5))
        velocity = mink.solve_ik(configuration, [task], dt, solver="daqp", damping=_REACH_DAMPING, limits=limits)
        configuration.integrate_inplace(velocity, dt)
        path.append(configuration.q.copy())
        path_velocity.append(velocity)
    return np.stack(path), np.stack([*path_velocity, np.zeros_like(goal)])


def _simulate(
    arm: Arm, control: _Control, horizon: int, dt: float, substeps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Trajectory [T+1, n] and torques [T, n] under a control: computed torque, once a step. None beyond a limit."""
    model = copy.copy(arm.model)
    model.opt.timestep = dt / substeps
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # else what diverges seems to rest
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
