"""Experts: what drives the arm in recorded demonstrations, each named for what it is.

An expert is a law that gives the torques of a control step from the arm's state. Those of "computed_torque", "reach",
"splines" and "steps" know the arm's dynamics exactly; "pid" has no model of them.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import Arm, finite_velocity_limit
from mimic.arms.simulation_model import effective_inertia

if TYPE_CHECKING:
    from scipy.interpolate import BPoly

MIXED = "mixed"  # each of `KINDS` in turn
GOAL_SHARE = 0.5  # goals lie within this fraction of the way from the home pose to the joint limits
# Critically damped, at 2 rad/s. A goal that is pi/2 away needs a peak speed of 1.2 rad/s (omega * distance / e), within
# every joint's velocity limit, and is reached to within 1 % in 3.3 s of the 5 s.
GOAL_FREQUENCY = 2.0  # rad/s
_PID_INTEGRAL = 0.3  # rad/s, the slow pole of a PID controller, beside two at `GOAL_FREQUENCY`
PATH_FREQUENCY = 4.0  # rad/s, of the feedback along a path
REACH_TIME = 3.0  # s, after which the hand has reached its goal and stays there
_REACH_SPEED_FRACTION = 0.9  # of the velocity limit, for inverse kinematics; the feedback needs the rest
_REACH_DAMPING = 1e-2  # regularises inverse kinematics near the stretched arm, a singularity where episodes start
_REACH_SETTLING = 5  # steps at the goal, after which inverse kinematics no longer moves the arm
_STEP_TIME = 1.5, 3.0  # s, from one goal to the next
# Mean speed between two goals, of the velocity limit; a quintic path from rest to rest peaks at 1.9 times that.
_SPLINE_SPEED = 0.08, 0.42
_SPLINE_TIME = 0.4  # s, at least, between two goals
_HOLD_PROBABILITY, _HOLD_TIME = 0.2, (0.3, 1.0)  # of resting at a goal, and s

InverseDynamics = Callable[[np.ndarray], np.ndarray]  # joint accelerations -> torques
# (step, joint angles, joint velocities, inverse dynamics at them) -> torques
Law = Callable[[int, np.ndarray, np.ndarray, InverseDynamics], np.ndarray]


class Expert(NamedTuple):
    """Drives one demonstration.

    Attributes:
      law: gives the torques of a control step.
      goal: [joints] the last target pose [rad].
    """

    law: Law
    goal: Float[np.ndarray, " joints"]


def make_expert(kind: str, arm: Arm, rng: np.random.Generator, horizon: int, dt: float) -> Expert:
    """Draws an expert of a kind of `KINDS`.

    Args:
      kind: the kind.
      arm: the arm that it drives from its home pose.
      rng: random numbers.
      horizon: control steps of the demonstration.
      dt: duration of a control step [s].
    """
    return _EXPERTS[kind](arm, rng, horizon, dt)


def _random_goal(arm: Arm, rng: np.random.Generator) -> Float[np.ndarray, " joints"]:
    home = np.asarray(arm.embodiment.home)
    lower, upper = np.asarray(arm.embodiment.joint_range).T
    return home + GOAL_SHARE * (rng.uniform(lower, upper) - home)


def _computed_torque(arm: Arm, rng: np.random.Generator, horizon: int, dt: float) -> Expert:
    """Linear feedback to one goal through exact inverse dynamics: all joints have the same course of time."""
    del horizon, dt
    goal = _random_goal(arm, rng)
    return Expert(lambda step, qpos, qvel, inverse: inverse(_to_goal(goal, qpos, qvel)), goal)


def _to_goal(goal: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    return GOAL_FREQUENCY**2 * (goal - qpos) - 2 * GOAL_FREQUENCY * qvel


def _pid(arm: Arm, rng: np.random.Generator, horizon: int, dt: float) -> Expert:
    """A PID controller for each joint, tuned for its effective inertia at home, without a model of the dynamics.

    The gains are those that give the joint alone two poles at `GOAL_FREQUENCY` and a slow one.
    """
    del horizon
    goal, fast, slow = _random_goal(arm, rng), GOAL_FREQUENCY, _PID_INTEGRAL
    home, damping = np.asarray(arm.embodiment.home), np.asarray(arm.model.dof_damping)
    # A joint's own damping is part of the derivative gain; where it is more than that, the joint moves more slowly.
    inertia = np.maximum(effective_inertia(arm.model, home), damping / (2 * fast + slow))
    integral = np.zeros_like(home)

    def law(step: int, qpos: np.ndarray, qvel: np.ndarray, inverse: InverseDynamics) -> np.ndarray:
        del step, inverse
        error = goal - qpos
        integral[:] += error * dt
        command = (fast**2 + 2 * fast * slow) * error + fast**2 * slow * integral - (2 * fast + slow) * qvel
        return inertia * command + damping * qvel

    return Expert(law, goal)


def _steps(arm: Arm, rng: np.random.Generator, horizon: int, dt: float) -> Expert:
    """As "computed_torque", to a goal that changes."""
    goals, changes = [_random_goal(arm, rng)], [rng.uniform(*_STEP_TIME)]
    while changes[-1] < horizon * dt:
        goals.append(_random_goal(arm, rng))
        changes.append(changes[-1] + rng.uniform(*_STEP_TIME))

    def law(step: int, qpos: np.ndarray, qvel: np.ndarray, inverse: InverseDynamics) -> np.ndarray:
        return inverse(_to_goal(goals[int(np.searchsorted(changes, step * dt, side="right"))], qpos, qvel))

    return Expert(law, goals[-1])


def _splines(arm: Arm, rng: np.random.Generator, horizon: int, dt: float) -> Expert:
    """Through several goals along quintic splines, with rests; joints move together or each in its own time."""
    times = np.arange(horizon + 2) * dt
    speed = rng.uniform(*_SPLINE_SPEED) * finite_velocity_limit(arm.embodiment)
    home, joints = np.asarray(arm.embodiment.home), np.arange(len(speed))
    groups = [joints] if rng.random() < 0.5 else list(joints[:, None])
    path, velocity = (np.empty((len(times), len(joints))) for _ in range(2))
    for group in groups:
        spline = _spline(lambda group=group: _random_goal(arm, rng)[group], home[group], speed[group], times[-1], rng)
        path[:, group], velocity[:, group] = spline(times), spline(times, 1)
    return Expert(_along(path, velocity, dt), path[-1])


def _spline(
    draw_goal: Callable[[], np.ndarray], start: np.ndarray, speed: np.ndarray, end: float, rng: np.random.Generator
) -> "BPoly":
    """A quintic spline from rest at a start through random goals, with continuous acceleration, at least until `end`.

    Velocities at goals are those of the chord from the goal before to the goal after, and 0 at both ends of a rest.
    """
    from scipy.interpolate import BPoly  # takes half a second, and only this kind of demonstration needs it

    times, goals, moves = [0.0], [start], []
    while times[-1] <= end:
        rests = rng.random() < _HOLD_PROBABILITY
        goals.append(goals[-1] if rests else draw_goal())
        duration = rng.uniform(*_HOLD_TIME)
        if not rests:
            duration = max(_SPLINE_TIME, float(np.max(np.abs(goals[-1] - goals[-2]) / speed)))
        moves.append(not rests)
        times.append(times[-1] + duration)
    t, x = np.array(times), np.stack(goals)
    velocity = np.zeros_like(x)
    passes = np.logical_and(moves[:-1], moves[1:])
    velocity[1:-1] = np.where(passes[:, None], (x[2:] - x[:-2]) / (t[2:] - t[:-2])[:, None], 0.0)
    return BPoly.from_derivatives(t, np.stack([x, velocity, np.zeros_like(x)], axis=1))


def _reach(arm: Arm, rng: np.random.Generator, horizon: int, dt: float) -> Expert:
    """Feedback along the joint path that moves the hand to its frame in a random pose."""
    goal = _random_goal(arm, rng)
    return Expert(_along(*_reach_path(arm, goal, horizon, dt), dt), goal)


def _along(path: np.ndarray, velocity: np.ndarray, dt: float) -> Law:
    """Feedback along a path that is given at each control step."""
    acceleration = np.diff(velocity, axis=0, append=velocity[-1:]) / dt

    def law(step: int, qpos: np.ndarray, qvel: np.ndarray, inverse: InverseDynamics) -> np.ndarray:
        position_error, velocity_error = path[step] - qpos, velocity[step] - qvel
        return inverse(acceleration[step] + PATH_FREQUENCY**2 * position_error + 2 * PATH_FREQUENCY * velocity_error)

    return law


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
    moving = math.ceil(REACH_TIME / dt)
    for step in range(horizon):
        progress = min((step + 1) * dt / REACH_TIME, 1.0)
        velocity = np.zeros_like(goal)
        if step < moving + _REACH_SETTLING:  # the rest is at the goal
            task.set_target(start.interpolate(end, alpha=10 * progress**3 - 15 * progress**4 + 6 * progress**5))
            velocity = mink.solve_ik(configuration, [task], dt, solver="daqp", damping=_REACH_DAMPING, limits=limits)
            configuration.integrate_inplace(velocity, dt)
        path.append(configuration.q.copy())
        path_velocity.append(velocity)
    return np.stack(path), np.stack([*path_velocity, np.zeros_like(goal)])


_EXPERTS = {
    "computed_torque": _computed_torque, "pid": _pid, "reach": _reach, "splines": _splines, "steps": _steps
}  # fmt: skip
KINDS = tuple(_EXPERTS)


def kind_of(kind: str, index: int) -> str:
    """The kind of a demonstration: that of the set, or of "mixed" each of `KINDS` in turn."""
    return KINDS[index % len(KINDS)] if kind == MIXED else kind


def inverse_dynamics(model: mujoco.MjModel, data: mujoco.MjData) -> InverseDynamics:
    """Torques for joint accelerations in a state for which `mj_forward` was called."""
    inertial = np.zeros(model.nv)

    def torques(acceleration: np.ndarray) -> np.ndarray:
        mujoco.mj_mulM(model, data, inertial, acceleration)
        return inertial + data.qfrc_bias - data.qfrc_passive

    return torques
