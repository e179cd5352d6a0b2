"""A checkbox that records the scene of a view as an HTML file, which opens in any browser without mimic."""

from typing import Any

import viser

from mimic.viewer.html import LAST

LONGEST = 120.0  # s of a recording; it is kept in memory
FILE = "mimic-recording.html"


class Recorder:
    """Records the scene while its box is checked; then the user's browser downloads the file.

    Args:
      server: server of the view.
    """

    def __init__(self, server: viser.ViserServer):
        self._server = server
        self._serializer: Any = None
        self._client: Any = None
        self._duration = 0.0
        self._box = server.gui.add_checkbox("record", False, hint=f"as {FILE}, at most {LONGEST:.0f} s", order=LAST + 1)
        self._box.on_update(lambda event: self._toggle(event.client))

    def advance(self, dt: float) -> None:
        """Ends the last frame of a recording after its time [s]."""
        serializer = self._serializer
        if serializer is None:
            return
        serializer.insert_sleep(dt)
        self._duration += dt
        if self._duration > LONGEST:
            self._box.value = False
            self._finish()

    def _toggle(self, client: Any) -> None:
        if client is None:  # the code, not the user
            return
        if self._box.value and self._serializer is None:
            self._client, self._duration = client, 0.0
            self._serializer = self._server.get_scene_serializer()
        elif not self._box.value:
            self._finish()

    def _finish(self) -> None:
        serializer, self._serializer = self._serializer, None
        if serializer is not None:
            self._client.send_file_download(FILE, serializer.as_html().encode(), save_immediately=True)
