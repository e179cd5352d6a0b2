"""The controls of a live view: expert, metric and hand, each in a tab."""

from typing import Protocol

import viser

from mimic.envs.config import EnvConfig
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
        self._hand = HandControls(session)
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Expert"):
            expert.add_widgets(server)
        with tabs.add_tab("Metric"):
            self._add_metric()
        with tabs.add_tab("Hand"):
            self._hand.add_widgets(server)

    def update(self) -> None:
        """Shows the settings of the session, after one that was not possible."""
        self._hand.update()

    def _add_metric(self) -> None:
        gui, session, metric = self._server.gui, self._session, self._env.metric
        for term in ("rotation", "translation"):
            initial = getattr(metric, term)
            is_left_out = term == "translation" and initial == 0  # the compiled functions lack the term
            weight = gui.add_slider(
                term, 0.0, max(_MAX_WEIGHT, initial), _WEIGHT_STEP, initial,
                disabled=metric.adaptive or is_left_out, hint="weight of this term of the distance",
            )  # fmt: skip
            weight.on_update(by_user(lambda value, term=term: session.weigh(**{term: float(value)})))
