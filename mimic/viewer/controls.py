"""The controls of a live view: sliders, buttons and switches that act on a `LiveSession`."""

import functools
import time
from typing import Any

import numpy as np
import viser

from mimic.arms.arm import build_arm
from mimic.envs.config import EnvConfig
from mimic.envs.demonstrations import Demonstrations
from mimic.envs.recording import record_demonstrations
from mimic.metric.config import CORRESPONDENCES
from mimic.viewer.follower import home_angles
from mimic.viewer.hand import hand_position
from mimic.viewer.live_session import LiveSession
from mimic.viewer.meshes import ArmShape
from mimic.viewer.messages import HAND

_DEMONSTRATIONS = 8  # number to choose from; recorded when the first one is played
_MAX_WEIGHT, _WEIGHT_STEP = 2.0, 0.05
_ANGLE_STEP = 0.01  # rad
_DRAG_PAUSE = 0.3  # s after the last message of a drag, for which the handle stays where the user holds it


class LiveControls:
    """Widgets of a live view.

    Args:
      server: server that shows the widgets.
      session: session that the widgets control.
      env: environment that defines the arms.
      expert: meshes of the expert, at whose hand a handle is drawn.
      can_lock: whether the learner's joints can be locked; the joints of a trained pose mapper are fixed.
    """

    def __init__(
        self, server: viser.ViserServer, session: LiveSession, env: EnvConfig, can_lock: bool, expert: ArmShape
    ):
        self._server, self._session, self._env = server, session, env
        self._random = np.random.default_rng()
        self._demonstrations: Demonstrations | None = None
        self._was_moving = False  # whether the expert moved by itself at the last update
        self._add_hand(expert)
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Expert"):
            self._add_buttons()
            self._add_sliders()
        with tabs.add_tab("Metric"):
            self._add_metric()
        with tabs.add_tab("Learner"):
            self._add_learner(can_lock)

    def update(self) -> None:
        """Updates the sliders of an expert that moves by itself.

        Otherwise the sliders are not set: a slider that the user drags is ahead of the session and would jump back.
        """
        moving = self._session.moves_by_itself or time.perf_counter() - self._dragged < _DRAG_PAUSE
        if time.perf_counter() - self._dragged > _DRAG_PAUSE:  # otherwise the user holds it
            self._hand.position = hand_position(self._session.expert, self._session.pose)
        if moving or self._was_moving:
            for slider, angle in zip(self._sliders, self._session.pose, strict=True):
                slider.value = round(float(np.clip(angle, slider.min, slider.max)), 2)
        self._was_moving = moving

    def undo_locks(self) -> None:
        """Restores the checkboxes of the locked joints after an invalid choice."""
        for name, box in self._locks.items():
            box.value = name in self._session.settings.locked

    def _add_hand(self, expert: ArmShape) -> None:
        scene, session = self._server.scene, self._session
        position, wxyz = expert.base_pose()
        scene.add_frame(HAND.rpartition("/")[0], show_axes=False, position=position, wxyz=wxyz)
        start = hand_position(session.expert, session.pose)
        self._dragged = -_DRAG_PAUSE
        self._hand = scene.add_transform_controls(
            HAND, scale=0.15 * expert.reach, disable_rotations=True, depth_test=False, position=start
        )

        @self._hand.on_update
        def _(event: Any) -> None:
            self._dragged = time.perf_counter()
            session.drag(np.asarray(event.target.position, float))

    def _add_buttons(self) -> None:
        gui, session = self._server.gui, self._session
        buttons = gui.add_button_group("go to", ("random pose", "home pose"))
        self._selected = gui.add_dropdown("demonstration", [str(i + 1) for i in range(_DEMONSTRATIONS)])
        playback = gui.add_button_group("motion", ("play", "stop"))

        @buttons.on_click
        def _(event: viser.GuiEvent) -> None:
            lower, upper = session.expert.joint_range.T
            home = event.target.value == "home pose"
            session.glide(session.expert.home if home else self._random.uniform(lower, upper))

        @playback.on_click
        def _(event: viser.GuiEvent) -> None:
            session.stop()
            if event.target.value == "play":
                self._play(int(self._selected.value) - 1)

    def _play(self, index: int) -> None:
        if self._demonstrations is None:
            expert = build_arm(self._env.expert, self._env.limits)
            self._demonstrations = record_demonstrations(
                expert, _DEMONSTRATIONS, horizon=self._env.horizon, dt=self._env.control_dt
            )
        poses = self._demonstrations.qpos[index]
        self._session.play(self._demonstrations.dt * np.arange(len(poses)), poses)

    def _add_sliders(self) -> None:
        session, arm = self._session, self._session.expert
        self._sliders = []
        for joint, (name, (lower, upper)) in enumerate(zip(arm.joint_names, arm.joint_range, strict=True)):
            bounds = round(float(lower), 2), round(float(upper), 2)
            start = round(float(np.clip(session.pose[joint], *bounds)), 3)
            slider = self._server.gui.add_slider(name, *bounds, _ANGLE_STEP, start, hint="rad")
            slider.on_update(_by_user(functools.partial(session.move, joint)))
            self._sliders.append(slider)

    def _add_metric(self) -> None:
        gui, session, settings = self._server.gui, self._session, self._session.settings
        choices = tuple(dict.fromkeys((*CORRESPONDENCES, settings.correspondence)))  # a run may have one of its own
        correspondence = gui.add_dropdown("correspondence", choices, initial_value=settings.correspondence)
        correspondence.on_update(_by_user(lambda value: session.change(correspondence=value)))
        for term in ("rotation", "translation"):
            initial = getattr(settings, term)
            weight = gui.add_slider(
                term, 0.0, max(_MAX_WEIGHT, initial), _WEIGHT_STEP, initial,
                disabled=self._env.metric.adaptive or bool(self._env.metric.link_distance),
                hint="weight of this term of the distance",
            )  # fmt: skip
            weight.on_update(_by_user(lambda value, term=term: session.change(**{term: float(value)})))
        gui.add_markdown("A new correspondence, and a first weight on translation, take some seconds to compile.")

    def _add_learner(self, can_lock: bool) -> None:
        gui, session = self._server.gui, self._session
        escape = gui.add_checkbox(
            "leave local minima", session.escape, disabled=not can_lock,
            hint="when the expert rests, continue to the best pose of many initial guesses",
        )  # fmt: skip
        escape.on_update(_by_user(lambda value: setattr(session, "escape", value)))
        self._locks = {
            name: gui.add_checkbox(
                f"lock {name}", name in session.settings.locked, disabled=not can_lock, hint=f"at {angle:.2f} rad"
            )
            for name, angle in home_angles(self._env).items()
        }
        for box in self._locks.values():
            box.on_update(_by_user(self._lock))

    def _lock(self, _: Any) -> None:
        self._session.change(locked=tuple(name for name, box in self._locks.items() if box.value))


def _by_user(callback: Any) -> Any:
    """Calls back with the new value of a widget if the user changed it, not if the code did."""

    def on_update(event: viser.GuiEvent) -> None:
        if event.client is not None:
            callback(event.target.value)

    return on_update
