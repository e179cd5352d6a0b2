"""The controls of an expert that the user moves: sliders, a handle at its hand, buttons and demonstrations."""

import functools
import time
from typing import Any

import numpy as np
import viser

from mimic.arms.arm import build_arm
from mimic.envs.config import EnvConfig
from mimic.motions.demonstrations import Demonstrations
from mimic.motions.recording import record_demonstrations
from mimic.viewer.hand import hand_position
from mimic.viewer.live_session import LiveSession
from mimic.viewer.meshes import ArmShape

HAND = "/expert/base/hand"  # name of the handle that drags the expert's hand
_DEMONSTRATIONS = 8  # number to choose from; recorded when the first one is played
_ANGLE_STEP = 0.01  # rad
_DRAG_PAUSE = 0.3  # s after the last message of a drag, for which the handle stays where the user holds it


class ManualControls:
    """Widgets that move the expert of a session.

    Args:
      session: session that the widgets control.
      env: environment that defines the expert.
      expert: meshes of the expert, at whose hand a handle is drawn.
    """

    def __init__(self, session: LiveSession, env: EnvConfig, expert: ArmShape):
        self._session, self._env, self._expert = session, env, expert
        self._random = np.random.default_rng()
        self._demonstrations: Demonstrations | None = None
        self._handle_pose: np.ndarray | None = None  # of the expert, for which the handle was placed
        self._was_moving = False  # whether the expert moved by itself at the last update

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        self._add_hand(server)
        self._add_buttons(server)
        self._add_sliders(server)

    def advance(self, dt: float) -> None:
        """Does nothing: the session itself moves an expert along a demonstration."""

    def update(self) -> None:
        """Updates the sliders of an expert that moves by itself.

        Otherwise the sliders are not set: a slider that the user drags is ahead of the session and would jump back.
        """
        dragged, pose = time.perf_counter() - self._dragged < _DRAG_PAUSE, self._session.pose
        moving = self._session.moves_by_itself or dragged
        if dragged:  # the user holds the handle
            self._handle_pose = None
        elif self._handle_pose is None or not np.array_equal(pose, self._handle_pose):
            self._hand.position, self._handle_pose = hand_position(self._session.expert, pose), pose
        if moving or self._was_moving:
            for slider, angle in zip(self._sliders, pose, strict=True):
                slider.value = round(float(np.clip(angle, slider.min, slider.max)), 2)
        self._was_moving = moving

    def _add_hand(self, server: viser.ViserServer) -> None:
        scene, session, expert = server.scene, self._session, self._expert
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

    def _add_buttons(self, server: viser.ViserServer) -> None:
        gui, session = server.gui, self._session
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

    def _add_sliders(self, server: viser.ViserServer) -> None:
        session, arm = self._session, self._session.expert
        self._sliders = []
        for joint, (name, (lower, upper)) in enumerate(zip(arm.joint_names, arm.joint_range, strict=True)):
            bounds = round(float(lower), 2), round(float(upper), 2)
            start = round(float(np.clip(session.pose[joint], *bounds)), 3)
            slider = server.gui.add_slider(name, *bounds, _ANGLE_STEP, start, hint="rad")
            slider.on_update(by_user(functools.partial(session.move, joint)))
            self._sliders.append(slider)


def by_user(callback: Any) -> Any:
    """Calls back with the new value of a widget if the user changed it, not if the code did."""

    def on_update(event: viser.GuiEvent) -> None:
        if event.client is not None:
            callback(event.target.value)

    return on_update
