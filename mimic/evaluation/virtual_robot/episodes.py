"""Episodes of a controller on virtual robots in lockstep, and what is counted in them."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from mimic.control.joint_control import PERIOD, Reference, action_towards
from mimic.deploy.bundle import Bundle
from mimic.deploy.config import SafetyConfig
from mimic.deploy.policy import Policy
from mimic.deploy.runner import TickPolicy
from mimic.deploy.safety import SafetyLayer
from mimic.evaluation.virtual_robot.draws import World
from mimic.evaluation.virtual_robot.loops import ControlLoop
from mimic.evaluation.virtual_robot.robots import VirtualRobots

ABORTED = "aborted"  # the cause for which the safety layer no longer controls a robot


@dataclasses.dataclass(frozen=True)
class Episodes:
    """What happened in some episodes.

    Attributes:
      motion: [episodes] index of the motion.
      qpos, qvel: [episodes, ticks, joints] true state after each tick [rad, rad/s]; after an abort the arm is at rest.
      torque: [episodes, ticks, joints] commanded torque at the end of each tick [N m].
      aborts: [episodes] why the robot aborted, or "".
      stops: [episodes] why the safety layer stopped the arm for good, or "".
      interventions: [episodes] number of interventions of the safety layer, by kind.
      tracking_error: [episodes] largest tracking error [rad].
      clearance: [episodes] smallest clearance of a measured pose [m]; inf where nothing watches it.
    """

    motion: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    torque: np.ndarray
    aborts: np.ndarray
    stops: np.ndarray
    interventions: dict[str, np.ndarray]
    tracking_error: np.ndarray
    clearance: np.ndarray


def joined(parts: list[Episodes]) -> Episodes:
    """The episodes of all parts, in order."""
    fields = [field.name for field in dataclasses.fields(Episodes) if field.name != "interventions"]
    return Episodes(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields},
        interventions={
            name: np.concatenate([part.interventions[name] for part in parts]) for name in parts[0].interventions
        },
    )


def run_episodes(robots: VirtualRobots, controller: "SafeController", motion: np.ndarray) -> Episodes:
    """Runs one episode on each robot."""
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for tick in range(controller.ticks):
        for period in range(controller.periods):
            measured = robots.measure()
            if period == 0:
                controller.tick(tick, *measured)
            robots.step(controller.torque(*measured))
            controller.drop(~robots.is_active)
        rows.append((robots.qpos.copy(), robots.qvel * robots.is_active[:, None], robots.torque.copy()))
    qpos, qvel, torque = (np.stack(x, axis=1) for x in zip(*rows, strict=True))
    return Episodes(motion, qpos, qvel, torque, robots.cause.copy(), **controller.counted())


class Channel:
    """Delays and losses between robots and their policies, in ticks, see `WorldConfig`."""

    def __init__(self, world: World, size: int, seed: int):
        self._observation_delay, self._action_delay = world.observation_delay, world.action_delay
        self._loss, self._rng = world.packet_loss, np.random.default_rng([seed, 1])
        self._observations: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []
        self._robots, self._size = np.arange(len(world.action_delay)), size

    def observed(self, values: np.ndarray) -> np.ndarray:
        """What a policy observes at a tick, for the values [robots, numbers] at that tick."""
        self._observations.append(values)
        ticks = np.maximum(len(self._observations) - 1 - self._observation_delay, 0)
        return np.stack(self._observations)[ticks, self._robots]

    def arrived(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The actions [robots, numbers] that arrive at a tick, and whether there is one, for those that are sent."""
        self._actions.append(action)
        ticks = len(self._actions) - 1 - self._action_delay
        is_lost = self._rng.uniform(size=len(ticks)) < self._loss
        return np.stack(self._actions)[np.maximum(ticks, 0), self._robots], (ticks >= 0) & ~is_lost


@dataclasses.dataclass(frozen=True)
class TrackingPolicy:
    """Poses that a controller tracks in place of the policy of a bundle, see `tracking_controller`.

    Attributes:
      bundle: folder with inner loop and safety layer.
      poses: [motions, ticks, joints] after each tick [rad].
      lead: [ticks].
    """

    bundle: Path
    poses: np.ndarray
    lead: int


class Tracker:
    """A `TickPolicy` that tracks poses."""

    def __init__(self, policy: TrackingPolicy, bundle: Bundle, motion: np.ndarray):
        self._bundle, self._poses, self._lead = bundle, policy.poses[motion], policy.lead

    def act(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> np.ndarray:
        """See `TickPolicy`."""
        bundle, ahead = self._bundle, min(tick + self._lead, self._poses.shape[1]) - 1
        duration = self._lead * bundle.control_dt
        return action_towards(bundle.mode, self._poses[:, ahead] - reference.qpos, duration, bundle.parameters, np)


class SafeController:
    """A policy with the safety layer of a bundle, as `mimic.deploy` runs them, and the control loops of the robots.

    It controls robots in lockstep; all arrays are [robots, ...].

    Args:
      bundle: see `load_bundle`.
      motion: [robots] index of the motion.
      world: its delays and losses.
      robots: to be controlled.
      loop: of the robots, see `ControlLoop`.
      config: thresholds.
      seed: of the losses.
      policy: default None: that of the bundle.
    """

    def __init__(
        self,
        bundle: Bundle,
        motion: np.ndarray,
        world: World,
        robots: VirtualRobots,
        loop: str = "mimic",
        config: SafetyConfig | None = None,
        seed: int = 0,
        policy: TickPolicy | None = None,
    ):
        config = config or SafetyConfig()
        self._policy = policy or Policy(bundle, motion.tolist())
        self._layer = SafetyLayer(bundle, len(motion), config)
        self._channel = Channel(world, bundle.num_joints, seed)
        self.ticks, self.periods = bundle.ticks, bundle.periods
        self._latency, self._left, self._command = round(config.latency / PERIOD), -1, None
        qpos, qvel = robots.measure()
        self._layer.start(qpos.T, qvel.T, bundle.start_poses[motion].T)
        self._loop = ControlLoop(loop, bundle.parameters, bundle.limits, qpos)

    def tick(self, tick: int, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Begins a tick with a measurement."""
        reference = self._layer.reference
        values = np.concatenate([qpos, qvel, reference.qpos.T, reference.qvel.T], axis=1)
        seen = np.split(self._channel.observed(values), 4, axis=1)
        action, is_present = self._channel.arrived(
            self._policy.act(tick, seen[0], seen[1], Reference(seen[2], seen[3], seen[3]))
        )
        self._command = self._layer.tick(qpos.T, qvel.T, action.T, is_present)
        self._left = self._latency

    def torque(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The torques of a period, from a measurement; the command of a tick acts after the latency."""
        if self._left == 0 and self._command is not None:
            self._loop.command(self._command)
        self._left -= 1
        return self._loop.torque(qpos, qvel)

    def drop(self, is_aborted: np.ndarray) -> None:
        """Is told which robots have aborted."""
        self._layer.release(is_aborted, ABORTED)

    def counted(self) -> dict[str, Any]:
        """`stops`, `interventions`, `tracking_error` and `clearance` of the episodes."""
        layer = self._layer
        return {
            "stops": np.where(layer.cause == ABORTED, "", layer.cause),
            "interventions": layer.counts,
            "tracking_error": layer.tracking_error,
            "clearance": layer.clearance,
        }
