"""The names that `import mimic` offers."""

import mimic


def test_every_public_name_exists():
    for name in mimic.__all__:
        assert getattr(mimic, name) is not None


def test_dir_lists_the_public_names_alone():
    assert set(dir(mimic)) == set(mimic.__all__)
