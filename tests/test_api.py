"""The names that `import mimic` offers."""

import mimic


def test_every_public_name_exists():
    for name in mimic.__all__:
        assert getattr(mimic, name) is not None
