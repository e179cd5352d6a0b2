"""The names that `import mimic` offers."""

import mimic


def test_api_resolves():
    for name in mimic.__all__:
        assert getattr(mimic, name) is not None
