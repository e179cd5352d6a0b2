"""Settings as text: Hydra reads back the value, a shell one word."""

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import QuotedString

from mimic.base.overrides import setting, shell_words

VALUES = (
    None, True, -1, 2.5, 1e-9, "", "a", "a b", "it's", "x=1", "a,b", "null", "1e3", "3", "\\", "a\\'b", "a\\", "~/x",
    "[a]", "{x}", "ünï", "a:b", "(x)", "#x", "/tmp/a=b", "-1", "01.npz", "a $b `c`", "!a",
    "a;b", 'a"b', ["*"], [1, "2", "a b"], {"joint 1": 0.5, "j:2": [1]},
)  # fmt: skip


def read(value):
    if isinstance(value, QuotedString):
        return value.text
    if isinstance(value, dict):
        return {read(key): read(entry) for key, entry in value.items()}
    return [read(entry) for entry in value] if isinstance(value, list) else value


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_settings_are_read_back(value):
    (word,) = shlex.split(shell_words([setting("env.key", value)]))
    parsed = OverridesParser.create().parse_override(word)
    assert parsed.key_or_group == "env.key" and read(parsed.value()) == value


def test_quotes_of_a_shell_are_others_than_hydras():
    assert shell_words([setting("out", "01.npz"), setting("arm", "left")]) == "\"out='01.npz'\" arm=left"
