"""State of a live view: motion of the expert, motion of the learner, and the frames to show. Needs no browser."""

import dataclasses
import math
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from mimic.arms.arm import finite_velocity_limit
from mimic.arms.embodiment import Embodiment
from mimic.envs.config import EnvConfig
from mimic.retargeting.teleoperation_recording import TeleoperationRecorder
from mimic.viewer.hand_following import FREE, HandDrag, HandFollower, HandFrame, HandSettings
from mimic.viewer.tracking import (
    CompiledFunctions,
    FunctionCache,
    Mapper,
    PoseComparison,
    Settings,
    initial_settings,
    lock_angles,
    step_towards,
)

RATE = 30.0  # frames per second, as in a video
_GLIDE = 1.0  # s, duration of the expert's motion to the pose of a button
_REST_TIME = 0.25  # s that the expert rests before the learner may leave a local minimum
_REST_ANGLE = 1e-4  # rad; a joint that moves less is at rest
_MIN_GAIN = 1e-3  # fraction of the distance that another minimum must save
_SETTLED = 2.0  # s that the expert rests before a hand that follows counts as at rest


@dataclasses.dataclass(frozen=True)
class Frame:
    """Content of the view at one time.

    Attributes:
      expert, learner: angle of every joint by name, including locked joints [rad].
      locked: locked joints of the learner.
      expert_links, learner_links: names of the links, base to tip.
      distance: embodiment distance.
      bound: kinematic bound of the distance; NaN while it is unknown.
      matrix: correspondence matrix W.
      links: weighted distance D' of every pair of links.
      similarity: measures of `mimic.metric.similarity` by name.
      hand: of a learner whose hand follows the expert's.
    """

    expert: Mapping[str, float]
    learner: Mapping[str, float]
    locked: tuple[str, ...]
    expert_links: tuple[str, ...]
    learner_links: tuple[str, ...]
    distance: float
    bound: float
    matrix: Float[np.ndarray, "expert learner"]
    links: Float[np.ndarray, "expert learner"]
    similarity: Mapping[str, float]
    hand: HandFrame | None = None


class LiveSession:
    """An expert that the user moves, and a learner that tracks it. The methods are thread-safe.

    Args:
      env: environment that defines the arms and the metric.
      mapper: pose mapper that moves the learner instead of the optimiser.
      hand: how the learner's hand follows, at the start.
      is_recorded: whether what the hand drives is kept.

    Attributes:
      expert: embodiment of the expert.
      settings: requested settings; they take effect as soon as their functions are compiled.
      hand: how the learner's hand follows, with the optimiser.
      by_optimiser: whether the optimiser moves the learner, not a pose mapper, whose joints cannot be locked.

    Raises:
      ValueError: an arm is invalid.
    """

    def __init__(
        self,
        env: EnvConfig,
        mapper: Mapper | None = None,
        hand: HandSettings | None = None,
        is_recorded: bool = False,
    ):
        self.hand: HandSettings = hand or HandSettings()
        self.expert: Embodiment = env.build_arm("expert").embodiment
        self.settings: Settings = initial_settings(env)
        self.by_optimiser = mapper is None
        self._functions = FunctionCache(env, mapper)
        self._lock_angles = lock_angles(env)
        self._lock = threading.RLock()
        self._angles = dict(self._lock_angles)  # of all joints of the learner [rad]
        self._pose = np.array(self.expert.home, np.float32)
        self._motion: tuple[np.ndarray, np.ndarray] | None = None  # times [s] and poses [rad] of the expert
        self._time = 0.0  # s, since the start of the motion
        self._rest_time = 0.0  # s, since the expert moved
        self._goal: np.ndarray | None = None  # pose of the learner to move to instead of the optimiser's
        self._seeks = False  # whether the learner is on its way to the best pose while the expert moves
        self._solved: tuple[Any, np.ndarray, float] | None = None  # request, best pose and bound
        self._drag, self._follower = HandDrag(self.expert), HandFollower(self.expert, env, is_recorded)
        self._gripper: float | None = None  # opening of the expert's
        self._active = self.settings  # the last settings with compiled functions
        self._rest_key: Any = None  # request for which the learner is at rest

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the learner's joints, base to tip, including those that are locked."""
        return tuple(self._lock_angles)

    @property
    def pose(self) -> Float[np.ndarray, " joints"]:
        """Pose of the expert [rad]."""
        return self._pose.copy()

    @property
    def moves_by_itself(self) -> bool:
        """Whether the expert moves to a pose, along a demonstration, or with its dragged hand."""
        return self._motion is not None or self._drag.goal is not None

    def move(self, joint: int, angle: float) -> None:
        """Sets one joint of the expert to an angle [rad] and stops any motion; NaN and infinity are dropped."""
        if not math.isfinite(angle):
            return
        with self._lock:
            self.stop()
            pose = self.pose
            pose[joint] = np.clip(angle, *self.expert.joint_range[joint])
            self._pose, self._rest_time, self._goal = pose, 0.0, None

    def drag_hand(self, goal: Float[np.ndarray, "4 4"], gripper: float | None = None) -> None:
        """Moves the expert's first hand to a pose in its base frame [m], as near as it gets; NaN is dropped.

        Args:
          goal: the pose.
          gripper: the opening, 0 to 1, that a learner takes whose hand follows; None leaves it.
        """
        if not np.all(np.isfinite(goal)):
            return
        with self._lock:
            self._motion, self._goal, self._drag.goal = None, None, goal
            if gripper not in (None, self._gripper):
                self._gripper, self._rest_key = gripper, None

    def show_pose(self, pose: Float[np.ndarray, " joints"]) -> None:
        """Sets the expert's pose [rad], one of a motion: the learner tracks it from where it is."""
        if not np.all(np.isfinite(pose)):
            return
        with self._lock:
            self.stop()
            self._pose, self._rest_time = np.asarray(pose, np.float32), 0.0

    def seek(self) -> None:
        """Moves the learner to the best pose of many initial guesses before it tracks again; for motions that jump."""
        with self._lock:
            self._seeks = self.by_optimiser

    def glide(self, pose: Float[np.ndarray, " joints"]) -> None:
        """Moves the expert to a pose [rad] within a second."""
        self.play(np.array([0.0, _GLIDE]), np.stack([self._pose, pose]))

    def play(self, times: Float[np.ndarray, " samples"], poses: Float[np.ndarray, "samples joints"]) -> None:
        """Moves the expert along poses [rad] at times [s]."""
        with self._lock:
            self._drag.goal = None
            self._motion, self._time, self._goal = (times, np.asarray(poses, np.float32)), 0.0, None

    def stop(self) -> None:
        """Stops the motion of the expert."""
        with self._lock:
            self._motion = self._drag.goal = None

    def follow_hand(self, **settings: Any) -> None:
        """Changes some of the `HandSettings`.

        Raises:
          ValueError: a value is invalid.
        """
        with self._lock:
            self.hand = dataclasses.replace(self.hand, **settings)
            self._goal = self._rest_key = None

    def change(self, **settings: Any) -> None:
        """Changes some of the `Settings`.

        Raises:
          ValueError: a value is invalid.
        """
        with self._lock:
            self.settings = dataclasses.replace(self.settings, **settings)
            self._goal = None

    def lock(self, joint: str, is_locked: bool) -> None:
        """Locks a joint of the learner, or frees it."""
        with self._lock:
            others = {name: at for name, at in self.settings.locked.items() if name != joint}
            self.change(locked={**others, joint: self._lock_angles[joint]} if is_locked else others)

    @property
    def is_compiling(self) -> bool:
        """Whether the functions of the requested settings are still being compiled, including the kinematic bound."""
        return not self._functions.is_complete(self.settings)

    def compile(self) -> CompiledFunctions:
        """Waits for the compiled functions of the requested settings and returns them."""
        return self._functions.wait(self.settings)

    def finish(self) -> None:
        """Waits for a running compilation."""
        self._functions.finish()

    @property
    def driven(self) -> list[TeleoperationRecorder]:
        """What the hand drove, a recorder for each of the settings."""
        return [recorder for recorder in self._follower.recorders if recorder.episodes]

    def advance(self, dt: float) -> Frame | None:
        """Advances the view by a time step [s].

        Returns:
          The frame to show; None if nothing has changed, or before the first functions are compiled.

        Raises:
          ValueError: the requested settings are invalid; the previous settings are restored.
        """
        with self._lock:
            functions = self._activate_functions()
            if functions is None:
                return None
            settings = self._active
            self._advance_expert(dt)
            arm, expert = functions.learner.embodiment, self._pose
            current = np.array([self._angles[name] for name in arm.joint_names], np.float32)
            request = expert.tobytes(), settings
            if self._rest_key == (request, functions.best is None):
                return None
            best, bound = self._best(functions, request)
            hand = None
            if self.hand.hand == FREE:
                self._follower.stop()
                pose = self._step(functions, current, best, bound, settings.weights, dt)
            else:
                pose, hand = self._follow_hand(arm, current, dt)
            comparison = functions.compare(expert, pose, settings.weights)
            self._angles |= dict(zip(arm.joint_names, map(float, pose), strict=True))
            self._angles |= functions.learner.locked
            is_at_rest = (
                self._goal is None
                and self._rest_time > (2 * _REST_TIME if hand is None else _SETTLED)
                and bool(np.all(np.abs(pose - current) < _REST_ANGLE))
            )
            self._rest_key = (request, functions.best is None) if is_at_rest else None
            return self._frame(functions, comparison, bound, hand)

    def _activate_functions(self) -> CompiledFunctions | None:
        """The functions of the requested settings, or until these are compiled, of the previous settings."""
        try:
            functions = self._functions.get(self.settings)
        except ValueError:
            self.settings = self._active
            raise
        if functions is None:
            return self._functions.get(self._active)
        self._active = self.settings
        return functions

    def _follow_hand(self, arm: Embodiment, current: np.ndarray, dt: float) -> tuple[np.ndarray, HandFrame]:
        """The learner's next pose with a hand that follows; it starts where the learner is.

        Raises:
          ValueError: the settings are not possible; the hand is left to the metric.
        """
        try:
            qpos, hand = self._follower.step(self.hand, self._active.locked, current, self._pose, dt, self._gripper)
        except ValueError:
            self.hand = dataclasses.replace(self.hand, hand=FREE)
            raise
        jump = finite_velocity_limit(arm) * dt
        return np.asarray(step_towards(arm, current, qpos, jump)[0], np.float32), hand

    def _frame(
        self, functions: CompiledFunctions, comparison: PoseComparison, bound: float, hand: HandFrame | None
    ) -> Frame:
        distance = float(comparison.distance)
        return Frame(
            expert=dict(zip(self.expert.joint_names, map(float, self._pose), strict=True)),
            learner=dict(self._angles),
            locked=tuple(self._active.locked),
            expert_links=self.expert.link_names,
            learner_links=functions.learner.embodiment.link_names,
            distance=distance,
            bound=min(bound, distance),  # many initial guesses may miss a minimum that the path has reached
            matrix=np.asarray(comparison.matrix),
            links=np.asarray(comparison.links),
            similarity={name: float(value) for name, value in comparison.similarity.items()},
            hand=hand,
        )

    def _advance_expert(self, dt: float) -> None:
        self._rest_time += dt
        if self._drag.goal is not None:
            self._pose, self._rest_time = self._drag.step(self._pose, dt), 0.0
        if self._motion is None:
            return
        times, poses = self._motion
        self._time += dt
        self._pose = np.array([np.interp(self._time, times, angles) for angles in poses.T], np.float32)
        self._rest_time = 0.0
        if self._time >= times[-1]:
            self._motion = None

    def _best(self, functions: CompiledFunctions, request: Any) -> tuple[np.ndarray, float]:
        """The best pose and its distance, computed once for each pose of the expert."""
        if functions.best is None:
            return self._pose, math.nan
        if self._solved is None or self._solved[0] != request:
            qpos, distance = functions.best(self._pose, request[1].weights)
            self._solved = request, np.asarray(qpos), float(distance)
        return self._solved[1:]

    def _step(
        self,
        functions: CompiledFunctions,
        current: np.ndarray,
        best: np.ndarray,
        bound: float,
        weights: np.ndarray,
        dt: float,
    ) -> np.ndarray:
        """The learner's next pose; no joint exceeds its velocity limit."""
        arm = functions.learner.embodiment
        jump = finite_velocity_limit(arm).astype(np.float32) * dt
        if self._seeks and functions.best is not None:
            self._goal = best
        goal = self._goal
        if goal is None or goal.shape != current.shape:
            goal = np.asarray(functions.track(self._pose, current, weights))
            self._goal = None
        pose, is_there = step_towards(arm, current, goal, jump)
        if self._goal is not None:
            self._goal, self._seeks = (None, False) if is_there else (self._goal, self._seeks)
        elif is_there and self.by_optimiser and self._rest_time > _REST_TIME:
            distance = float(functions.compare(self._pose, pose, weights).distance)
            if distance - bound > _MIN_GAIN * max(distance, _MIN_GAIN):
                self._goal = best
        return np.asarray(pose, np.float32)
