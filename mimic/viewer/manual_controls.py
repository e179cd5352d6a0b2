"""The controls of an expert that the user moves: sliders, buttons and demonstrations."""

import functools
from typing import Any

import numpy as np
import viser

from mimic.arms.arm import build_arm
from mimic.envs.config import EnvConfig
from mimic.motions.demonstrations import Demonstrations
from mimic.motions.recording import record_demonstrations
from mimic.viewer.live_session import LiveSession

_DEMONSTRATIONS = 8  # number to choose from; recorded when the first one is played
_ANGLE_STEP = 0.01  # rad


class ManualControls:
    """Widgets that move the expert of a session.

    Args:
      session: session that the widgets control.
      env: environment that defines the expert.
    """

    def __init__(self, session: LiveSession, env: EnvConfig):
        self._session, self._env = session, env
        self._random = np.random.default_rng()
        self._demonstrations: Demonstrations | None = None
        self._was_moving = False  # whether the expert moved by itself at the last update

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        self._add_buttons(server)
        self._add_sliders(server)

    def advance(self, dt: float) -> None:
        """Does nothing: the session itself moves an expert along a demonstration."""

    def update(self) -> None:
        """Updates the sliders of an expert that moves by itself.

        Otherwise the sliders are not set: a slider that the user drags is ahead of the session and would jump back.
        """
        moving = self._session.moves_by_itself
        if moving or self._was_moving:
            for slider, angle in zip(self._sliders, self._session.pose, strict=True):
                slider.value = round(float(np.clip(angle, slider.min, slider.max)), 2)
        self._was_moving = moving

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
