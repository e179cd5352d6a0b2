"""The controls of a live view: those of the expert, and sliders and switches of the metric and of the learner."""

from typing import Any, Protocol

import viser

from mimic.envs.config import EnvConfig
from mimic.metric.config import CORRESPONDENCES
from mimic.viewer.follower import home_angles
from mimic.viewer.live_session import LiveSession
from mimic.viewer.manual_controls import by_user

_MAX_WEIGHT, _WEIGHT_STEP = 2.0, 0.05


class ExpertControls(Protocol):
    """What moves the expert."""

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""

    def advance(self, dt: float) -> None:
        """Moves the expert by a time step [s]."""

    def update(self) -> None:
        """Updates the widgets."""


class LiveControls:
    """Widgets of a live view.

    Args:
      server: server that shows the widgets.
      session: session that the widgets control.
      env: environment that defines the arms.
      can_lock: whether the learner's joints can be locked; the joints of a trained pose mapper are fixed.
      expert: controls of the expert.
    """

    def __init__(
        self, server: viser.ViserServer, session: LiveSession, env: EnvConfig, can_lock: bool, expert: ExpertControls
    ):
        self._server, self._session, self._env = server, session, env
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Expert"):
            expert.add_widgets(server)
        with tabs.add_tab("Metric"):
            self._add_metric()
        with tabs.add_tab("Learner"):
            self._add_learner(can_lock)

    def undo_locks(self) -> None:
        """Restores the checkboxes of the locked joints after an invalid choice."""
        for name, box in self._locks.items():
            box.value = name in self._session.settings.locked

    def _add_metric(self) -> None:
        gui, session, settings = self._server.gui, self._session, self._session.settings
        choices = tuple(dict.fromkeys((*CORRESPONDENCES, settings.correspondence)))  # a run may have one of its own
        correspondence = gui.add_dropdown("correspondence", choices, initial_value=settings.correspondence)
        correspondence.on_update(by_user(lambda value: session.change(correspondence=value)))
        for term in ("rotation", "translation"):
            initial = getattr(settings, term)
            weight = gui.add_slider(
                term, 0.0, max(_MAX_WEIGHT, initial), _WEIGHT_STEP, initial,
                disabled=self._env.metric.adaptive or bool(self._env.metric.link_distance),
                hint="weight of this term of the distance",
            )  # fmt: skip
            weight.on_update(by_user(lambda value, term=term: session.change(**{term: float(value)})))
        gui.add_markdown("A new correspondence, and a first weight on translation, take some seconds to compile.")

    def _add_learner(self, can_lock: bool) -> None:
        gui, session = self._server.gui, self._session
        escape = gui.add_checkbox(
            "leave local minima", session.escape, disabled=not can_lock,
            hint="when the expert rests, continue to the best pose of many initial guesses",
        )  # fmt: skip
        escape.on_update(by_user(lambda value: setattr(session, "escape", value)))
        self._locks = {
            name: gui.add_checkbox(
                f"lock {name}", name in session.settings.locked, disabled=not can_lock, hint=f"at {angle:.2f} rad"
            )
            for name, angle in home_angles(self._env).items()
        }
        for box in self._locks.values():
            box.on_update(by_user(self._lock))

    def _lock(self, _: Any) -> None:
        self._session.change(locked=tuple(name for name, box in self._locks.items() if box.value))
