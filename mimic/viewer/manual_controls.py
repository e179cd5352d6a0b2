"""The controls of an expert that the user moves: sliders, buttons, its hand, and demonstrations."""

import functools
from typing import Any

import numpy as np
import viser

from mimic.arms.arm import build_arm
from mimic.arms.link_match import hand_poses
from mimic.arms.model_tree import quaternion
from mimic.envs.config import EnvConfig
from mimic.motions.demonstrations import Demonstrations
from mimic.motions.recording import record_demonstrations
from mimic.viewer.live_session import LiveSession
from mimic.viewer.meshes import pose_matrix
from mimic.viewer.page import EXPERT_BASE

_DEMONSTRATIONS = 8  # number to choose from; recorded when the first one is played
_ANGLE_STEP = 0.01  # rad
_HANDLE = 0.25  # size of the handle at the hand, in chain lengths


class ManualControls:
    """Widgets that move the expert of a session.

    Args:
      session: session that the widgets control.
      env: environment that defines the expert.
      demonstrations: of the expert, to choose from; None for random ones.
    """

    def __init__(self, session: LiveSession, env: EnvConfig, demonstrations: Demonstrations | None = None):
        self._session, self._env = session, env
        self._random = np.random.default_rng()
        self._demonstrations = demonstrations
        self._was_moving = False  # whether the expert moved by itself at the last update
        self._handle: Any = None  # at the hand; None for an expert without one
        self._is_dragged, self._shown = False, session.pose  # whether the user holds it, and the pose that it is of

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        self._add_buttons(server)
        self._add_sliders(server)
        if self._session.expert.hand_joint:
            self._add_handle(server)

    def advance(self, dt: float) -> None:
        """Updates the sliders of an expert that the session moves, along a demonstration or by its hand.

        Otherwise the sliders are not set: a slider that the user drags is ahead of the session and would jump back.
        """
        del dt
        self._move_handle()
        moving = self._session.moves_by_itself
        if moving or self._was_moving:
            for slider, angle in zip(self._sliders, self._session.pose, strict=True):
                slider.value = round(float(np.clip(angle, slider.min, slider.max)), 2)
        self._was_moving = moving

    def _add_handle(self, server: viser.ViserServer) -> None:
        """Adds a handle at the first hand, which the user drags and turns."""
        arm = self._session.expert
        scale = _HANDLE * float(arm.chain_length)
        self._handle = server.scene.add_transform_controls(f"{EXPERT_BASE}/hand", scale, depth_test=False, opacity=0.7)
        self._place_handle(self._session.pose)

        @self._handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:  # async: the phases keep their order
            self._is_dragged = event.phase != "end"
            self._session.drag_hand(pose_matrix(event.target.position, event.target.wxyz))

    def _move_handle(self) -> None:
        """Moves the handle to the hand, unless the user holds it."""
        pose = self._session.pose
        if self._handle is not None and not self._is_dragged and not np.array_equal(pose, self._shown):
            self._place_handle(pose)

    def _place_handle(self, pose: np.ndarray) -> None:
        self._shown = pose
        hand = hand_poses(self._session.expert, pose)[0]
        self._handle.position, self._handle.wxyz = hand[:3, 3], quaternion(hand[:3, :3])

    def _add_buttons(self, server: viser.ViserServer) -> None:
        gui, session = server.gui, self._session
        count = self._demonstrations.count if self._demonstrations else _DEMONSTRATIONS
        buttons = gui.add_button_group("go to", ("random pose", "home pose"))
        self._selected = gui.add_dropdown("demonstration", [str(i + 1) for i in range(count)])
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
