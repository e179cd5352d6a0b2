"""The state of a live view: what the expert does, how the learner follows, what is shown of it. Knows no browser."""

import dataclasses
import math
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from mimic.arms.arm import build_arm, finite_velocity_limit
from mimic.arms.embodiment import Embodiment
from mimic.envs.config import EnvConfig
from mimic.viewer.follower import Mapper, ProgramCache, Programs, Settings, home_angles, initial_settings, step_towards

_GLIDE = 1.0  # s, that the expert takes to a pose that a button gives
_STILL = 0.25  # s without a new pose of the expert, after which the learner may leave a local minimum
_RESTS = 1e-4  # rad: a joint that moves less is at rest
_WORTH_IT = 1e-3  # of the distance that another minimum must save


@dataclasses.dataclass(frozen=True)
class Frame:
    """What is seen at one moment.

    Attributes:
      expert, learner: angle [rad] of all joints by name, locked ones included.
      locked: the learner's locked joints.
      expert_links, learner_links: names of the links, base to tip.
      distance: embodiment distance.
      bound: the least that the learner could have; NaN while it is not known.
      matrix: correspondence W.
      links: weighted distance of every pair of links D'.
      similarity: measures of `mimic.metric.similarity` by name.
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


class LiveSession:
    """An expert that is moved, and a learner that follows. The methods may be called from any thread.

    Args:
      env: the arms and the metric.
      mapper: moves the learner instead of the optimiser.

    Attributes:
      expert: the arm.
      settings: what is asked for; shown as soon as its programs are compiled.

    Raises:
      ValueError: arms that cannot be built.
    """

    def __init__(self, env: EnvConfig, mapper: Mapper | None = None):
        self.expert: Embodiment = build_arm(env.expert, env.limits, env.metric.links).embodiment
        self.settings: Settings = initial_settings(env)
        self._escape = mapper is None
        self._programs = ProgramCache(env, mapper)
        self._lock = threading.RLock()
        self._angles = dict(home_angles(env))  # of the learner, all joints
        self._pose = np.array(self.expert.home, np.float32)
        self._motion: tuple[np.ndarray, np.ndarray] | None = None  # times [s] and poses that the expert goes through
        self._time = 0.0  # s, of the motion
        self._still = 0.0  # s since the expert moved
        self._goal: np.ndarray | None = None  # the learner's pose to go to, past the optimiser
        self._solved: tuple[Any, np.ndarray, float] | None = None  # for what; best pose and bound
        self._working = self.settings  # the last ones whose programs were there
        self._rested: Any = None  # for what the learner came to rest

    @property
    def pose(self) -> Float[np.ndarray, " joints"]:
        """The expert's [rad]."""
        return self._pose.copy()

    @property
    def moves_by_itself(self) -> bool:
        """Whether the expert is on its way to a pose or through a demonstration."""
        return self._motion is not None

    def move(self, joint: int, angle: float) -> None:
        """Puts one of the expert's joints to an angle [rad], and ends what motion there was."""
        with self._lock:
            self._motion = None
            pose = self.pose
            pose[joint] = np.clip(angle, *self.expert.joint_range[joint])
            self._pose, self._still, self._goal = pose, 0.0, None

    def glide(self, pose: Float[np.ndarray, " joints"]) -> None:
        """Lets the expert go to a pose [rad]."""
        self.play(np.array([0.0, _GLIDE]), np.stack([self._pose, pose]))

    def play(self, times: Float[np.ndarray, " samples"], poses: Float[np.ndarray, "samples joints"]) -> None:
        """Lets the expert go through poses [rad] at their times [s]."""
        with self._lock:
            self._motion, self._time, self._goal = (times, np.asarray(poses, np.float32)), 0.0, None

    def stop(self) -> None:
        """Ends what motion there is."""
        with self._lock:
            self._motion = None

    @property
    def escape(self) -> bool:
        """Whether a learner that rests in a local minimum goes on to the best pose."""
        return self._escape

    @escape.setter
    def escape(self, value: bool) -> None:
        with self._lock:
            self._escape, self._rested = value, None

    def change(self, **settings: Any) -> None:
        """Switches some of the `Settings`.

        Raises:
          ValueError: a value that they cannot have.
        """
        with self._lock:
            self.settings = dataclasses.replace(self.settings, **settings)
            self._goal = None

    @property
    def is_compiling(self) -> bool:
        """Whether what is asked for is still being compiled, the kinematic bound included."""
        return not self._programs.is_complete(self.settings)

    def compile(self) -> Programs:
        """The programs of the settings, waiting for them."""
        return self._programs.wait(self.settings)

    def finish(self) -> None:
        """Waits for what is being compiled."""
        self._programs.finish()

    def advance(self, dt: float) -> Frame | None:
        """The next moment, a time [s] later; None where nothing changed, or before the first programs are compiled.

        Raises:
          ValueError: settings that the arms cannot have; those before are back.
        """
        with self._lock:
            settings = self.settings
            try:
                programs = self._programs.get(settings)
            except ValueError:
                self.settings = self._working
                raise
            if programs is None:  # the view goes on as it was
                settings = self._working
                programs = self._programs.get(settings)
            if programs is None:
                return None
            self._working = settings
            self._go_on(dt)
            arm, expert = programs.learner.embodiment, self._pose
            present = np.array([self._angles[name] for name in arm.joint_names], np.float32)
            asked = expert.tobytes(), settings
            if self._rested == (asked, programs.best is None):
                return None
            best, bound = self._best(programs, asked)
            pose = self._step(programs, present, best, bound, settings.weights, dt)
            shown = programs.measure(expert, pose, settings.weights)
            self._angles |= dict(zip(arm.joint_names, map(float, pose), strict=True))
            self._angles |= programs.learner.locked
            rests = self._goal is None and self._still > 2 * _STILL and bool(np.all(np.abs(pose - present) < _RESTS))
            self._rested = (asked, programs.best is None) if rests else None
        distance = float(shown.distance)
        return Frame(
            expert=dict(zip(self.expert.joint_names, map(float, expert), strict=True)),
            learner=dict(self._angles),
            locked=settings.locked,
            expert_links=self.expert.link_names,
            learner_links=arm.link_names,
            distance=distance,
            bound=min(bound, distance),  # many starts may miss what one path found
            matrix=np.asarray(shown.matrix),
            links=np.asarray(shown.links),
            similarity={name: float(value) for name, value in shown.similarity.items()},
        )

    def _go_on(self, dt: float) -> None:
        self._still += dt
        if self._motion is None:
            return
        times, poses = self._motion
        self._time += dt
        self._pose = np.array([np.interp(self._time, times, angles) for angles in poses.T], np.float32)
        self._still = 0.0
        if self._time >= times[-1]:
            self._motion = None

    def _best(self, programs: Programs, asked: Any) -> tuple[np.ndarray, float]:
        """The best pose and its distance, searched once for each pose of the expert."""
        if programs.best is None:
            return self._pose, math.nan
        if self._solved is None or self._solved[0] != asked:
            qpos, distance = programs.best(self._pose, asked[1].weights)
            self._solved = asked, np.asarray(qpos), float(distance)
        return self._solved[1:]

    def _step(
        self,
        programs: Programs,
        present: np.ndarray,
        best: np.ndarray,
        bound: float,
        weights: np.ndarray,
        dt: float,
    ) -> np.ndarray:
        """The learner's next pose: no joint goes faster than its rated speed."""
        arm = programs.learner.embodiment
        jump = finite_velocity_limit(arm).astype(np.float32) * dt
        goal = self._goal
        if goal is None or goal.shape != present.shape:
            goal = np.asarray(programs.follow(self._pose, present, weights))
            self._goal = None
        pose, is_there = step_towards(arm, present, goal, jump)
        if self._goal is not None:
            self._goal = None if is_there else self._goal
        elif is_there and self._escape and self._still > _STILL:
            left = float(programs.measure(self._pose, pose, weights).distance)
            if left - bound > _WORTH_IT * max(left, _WORTH_IT):
                self._goal = best
        return np.asarray(pose, np.float32)
