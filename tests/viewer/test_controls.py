"""The controls of a live view on a page: which joints are locked, and what is drawn of it."""

import importlib.util

import pytest

if importlib.util.find_spec("viser") is None:
    pytest.skip("needs viser: pip install 'mimic-arms[view]'", allow_module_level=True)

from mimic.commands import view_server
from mimic.commands.config import ViewConfig
from mimic.envs import env_config
from mimic.viewer.controls import LiveControls
from mimic.viewer.live_session import LiveSession
from mimic.viewer.manual_controls import ManualControls
from tests.helpers.commands import free_port


@pytest.fixture
def serve():
    """Shows something on a page of the environment panda4dof, to the end."""
    config, done = ViewConfig(env=env_config("panda4dof"), port=free_port()), []

    def serve_once(show):
        def show_once(page, times):
            show(page, config)
            done.append(True)

        assert view_server.serve(config, config.env, show_once) == 0 and done

    return serve_once


def test_the_weights_of_the_metric_have_sliders(serve):
    def show(page, config):
        session = LiveSession(config.env)
        controls = LiveControls(page.server, session, config.env, ManualControls(session, config.env))
        controls.update()
        sliders = {handle.label: handle for handle in page.server.gui._gui_input_handle_from_uuid.values()}
        assert not sliders["rotation"].disabled and not sliders["translation"].disabled
        assert sliders["rotation"].value == config.env.metric.rotation

    serve(show)
