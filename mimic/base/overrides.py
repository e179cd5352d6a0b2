"""Settings as text: words of a command line that Hydra reads back as the same values, and a shell as one word."""

import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

_PLAIN = re.compile(r"[A-Za-z_./][\w./:@+-]*")  # read by Hydra as the text itself
_OTHER_TYPES = re.compile(r"null|true|false|inf|nan|[+-]?[\d._]+(e[+-]?\d+)?", re.IGNORECASE)


def setting(key: str, value: Any) -> str:
    """A setting in Hydra's syntax, as in env.learner.locked=[3,6,7]."""
    return f"{key}={_text(value)}"


def shell_words(words: Sequence[str]) -> str:
    """Words of a command as one line for a shell."""
    return " ".join(map(_shell_word, words))


def _shell_word(word: str) -> str:
    """A word in double quotes where this keeps Hydra's single ones readable, else as shlex quotes it."""
    return f'"{word}"' if "'" in word and not set(word) & set('"$`\\!') else shlex.quote(word)


def _text(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        is_plain = _PLAIN.fullmatch(value) and not _OTHER_TYPES.fullmatch(value)
        return value if is_plain else _quoted(value)
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{_escaped(str(key))}:{_text(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ",".join(map(_text, value)) + "]"
    return repr(value)


def _escaped(key: str) -> str:
    """A key of a mapping, which Hydra takes without quotes only."""
    return re.sub(r"([\\()\[\]{}:=, \t])", r"\\\1", key)


def _quoted(text: str) -> str:
    """In single quotes; backslashes are doubled only in front of a quote and at the end, as Hydra reads them."""
    return "'" + re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + (r"\'" if match[2] else ""), text) + "'"
