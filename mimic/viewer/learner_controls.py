"""The controls of a live view's learner: which arm it is, and which of its joints are locked."""

from collections.abc import Mapping, Sequence

import viser

from mimic.viewer.live_session import LiveSession
from mimic.viewer.manual_controls import by_user
from mimic.viewer.tracking import Preset, shown_preset


class LearnerControls:
    """Widgets that change the learner of a session.

    Args:
      session: session that the widgets control.
      starts: start pose of each arm that can be chosen, all joints by name [rad].
      presets: choices of the learner; none where it is fixed.
    """

    def __init__(self, session: LiveSession, starts: Sequence[Mapping[str, float]], presets: Sequence[Preset] = ()):
        self._session, self._starts, self._presets = session, starts, presets

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        gui, session = server.gui, self._session
        can_lock = session.by_optimiser or session.takes_any_arm  # a pose mapper to one learner has its locks
        if self._presets:
            names = [preset.name for preset in self._presets]
            self._arm = gui.add_dropdown("learner", names)
            self._arm.on_update(by_user(self._choose))
        self._locks = [
            {name: gui.add_checkbox(f"lock {name}", False, disabled=not can_lock) for name in start}
            for start in self._starts
        ]
        for name, box in [item for boxes in self._locks for item in boxes.items()]:
            box.on_update(by_user(lambda value, name=name: self._lock(name, value)))
        self._note = gui.add_markdown("", visible=can_lock)
        self.update()

    def update(self) -> None:
        """Shows the settings of the session."""
        settings = self._session.settings
        for arm, boxes in enumerate(self._locks):
            for name, box in boxes.items():
                box.visible, box.value = arm == settings.arm, name in settings.locked
        angles = {name: settings.locked[name] for name in self._starts[settings.arm] if name in settings.locked}
        locked = ", ".join(f"{name} at {angle:z.2f} rad" for name, angle in angles.items())
        where = "where it is" if self._session.takes_any_arm else "at its angle in the start pose"
        self._note.content = f"Locked: {locked}." if locked else f"A joint is locked {where}."
        if self._presets:
            self._arm.value = shown_preset(self._presets, settings.arm, settings.locked).name

    def _choose(self, name: str) -> None:
        preset = next(preset for preset in self._presets if preset.name == name)
        self._session.choose(preset.arm, preset.locked, self._starts[preset.arm])
        self.update()

    def _lock(self, name: str, is_locked: bool) -> None:
        self._session.lock(name, is_locked)
        self.update()
