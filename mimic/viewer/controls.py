"""The controls of a live view: expert, metric, the learner's locks and its hand, each in a tab."""

from typing import Protocol

import viser

from mimic.envs.config import EnvConfig
from mimic.metric.config import CORRESPONDENCES
from mimic.viewer.hand_controls import HandControls
from mimic.viewer.live_session import LiveSession
from mimic.viewer.manual_controls import by_user

_MAX_WEIGHT, _WEIGHT_STEP = 2.0, 0.05


class ExpertControls(Protocol):
    """What moves the expert."""

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""

    def advance(self, dt: float) -> None:
        """Moves the expert by a time step [s], and updates the widgets."""


class LiveControls:
    """Widgets of a live view.

    Args:
      server: server that shows the widgets.
      session: session that the widgets control.
      env: environment that defines the metric.
      expert: controls of the expert.
    """

    def __init__(self, server: viser.ViserServer, session: LiveSession, env: EnvConfig, expert: ExpertControls):
        self._server, self._session, self._env = server, session, env
        self._hand = HandControls(session) if session.by_optimiser else None
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Expert"):
            expert.add_widgets(server)
        with tabs.add_tab("Metric"):
            self._add_metric()
        with tabs.add_tab("Learner"):
            self._add_locks()
        if self._hand is not None:
            with tabs.add_tab("Hand"):
                self._hand.add_widgets(server)

    def update(self) -> None:
        """Shows the settings of the session, after one that was not possible."""
        self._show_locks()
        if self._hand is not None:
            self._hand.update()

    def _add_locks(self) -> None:
        gui, session = self._server.gui, self._session
        self._locks = {
            name: gui.add_checkbox(f"lock {name}", False, disabled=not session.by_optimiser) for name in session.joints
        }
        for name, box in self._locks.items():
            box.on_update(by_user(lambda value, name=name: self._lock(name, value)))
        self._note = gui.add_markdown("", visible=session.by_optimiser)
        self._show_locks()

    def _lock(self, name: str, is_locked: bool) -> None:
        self._session.lock(name, is_locked)
        self._show_locks()

    def _show_locks(self) -> None:
        locked = self._session.settings.locked
        for name, box in self._locks.items():
            box.value = name in locked
        angles = ", ".join(f"{name} at {locked[name]:z.2f} rad" for name in self._locks if name in locked)
        self._note.content = f"Locked: {angles}." if angles else "A joint is locked at its angle in the start pose."

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
