"""Each benchmark can be imported and says what it measures. Tests beside this one are of those that pages rest on."""

import importlib

import pytest

from tests.helpers.repository import REPOSITORY

FOLDERS = "benchmarks", "benchmarks/figures"
COMMANDS = sorted(
    ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
    for folder in FOLDERS
    for path in (REPOSITORY / folder).glob("*.py")
    if "make_parser(" in path.read_text()
)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_shows_its_help(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(name).main()
    assert stop.value.code == 0 and f"usage: python -m {name}" in capsys.readouterr().out
