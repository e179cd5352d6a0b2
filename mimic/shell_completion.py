"""Completion of the command `mimic` in a shell: commands, config groups, keys and files.

A shell asks `mimic completion query LINE`, which answers by Hydra's completion of keys and groups, one candidate a
line. A candidate that ends with a space is a whole word.
"""

import contextlib
import sys
from collections.abc import Sequence

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.plugins.completion_plugin import DefaultCompletionPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mimic.base.config import BAD_INPUT
from mimic.commands import cli

_BASH = r"""# eval "$(mimic completion bash)"
_mimic() {
    local line="${COMP_LINE:0:COMP_POINT}" IFS=$'\n'
    local word="${line##* }"
    COMPREPLY=($(mimic completion query "$line" 2>/dev/null))
    local before="${word%"${word##*[=:]}"}"  # bash replaces what follows the last = or :
    COMPREPLY=("${COMPREPLY[@]#"$before"}")
    (( ${#COMPREPLY[@]} )) && compopt -o nospace  # files get a space from bash
}
complete -o default -F _mimic mimic
"""
_ZSH = r"""#compdef mimic
# eval "$(mimic completion zsh)", after compinit
_mimic() {
    local -a candidates whole partial
    candidates=("${(@f)$(mimic completion query "${(j: :)words[1,CURRENT-1]} $PREFIX" 2>/dev/null)}")
    whole=("${(@)${(@M)candidates:#* }% }") partial=("${(@)candidates:#* }")
    whole=(${whole:#}) partial=(${partial:#})
    (( $#whole )) && compadd -Q -- $whole
    (( $#partial )) && compadd -Q -S '' -- $partial
    (( $#whole + $#partial )) || { compset -P '*='; _files }
}
compdef _mimic mimic
"""
_FISH = r"""# mimic completion fish | source
function __mimic_candidates
    mimic completion query (commandline -cp | string collect) 2>/dev/null | string trim --right
end
complete -c mimic -a '(__mimic_candidates)'
"""
SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}


def complete(arguments: Sequence[str], commands: Sequence[str]) -> int:
    """Runs `mimic completion SHELL`, or `mimic completion query LINE`; returns the exit code."""
    match arguments:
        case ["query", line]:
            print("".join(f"{word}\n" for word in candidates(line, commands)), end="")
        case [shell] if shell in SCRIPTS:
            print(SCRIPTS[shell], end="")
        case _:
            got = " ".join(arguments) or "nothing"
            print(f"error: completion: expected one of {', '.join(SCRIPTS)}, got {got!r:.80}", file=sys.stderr)
            return BAD_INPUT
    return 0


def candidates(line: str, commands: Sequence[str]) -> list[str]:
    """Completions of the last word of a command line.

    Args:
      line: the line up to the cursor, from the word `mimic` on.
      commands: names of the commands.
    """
    words = line.split()
    if not line[-1:].isspace():
        *words, last = words or [""]
    else:
        last = ""
    if len(words) < 2:
        return [f"{name} " for name in commands if name.startswith(last)] if words else []
    command, *overrides = words[1:]
    if command == "completion":
        return [f"{shell} " for shell in SCRIPTS if shell.startswith(last)]
    is_path = last.rpartition("=")[2].startswith((".", "/", "~"))  # the shell completes files
    if command not in commands or last.startswith("-") or is_path:
        return []
    return _keys(command, overrides, last)


def _keys(command: str, overrides: Sequence[str], last: str) -> list[str]:
    """Hydra's completions of a word of a command, without our schemas and, unless asked for, Hydra's own keys."""
    cli.register()
    line = " ".join([*(cli.expand_shorthand(word, command) for word in overrides if "=" in word), last])
    with (
        contextlib.suppress(HydraException, OmegaConfBaseException, ValueError, AttributeError),  # of invalid words
        hydra.initialize_config_module("mimic.conf", version_base="1.3"),
    ):
        loader = GlobalHydra.instance().config_loader()
        words = DefaultCompletionPlugin(loader)._query(command, line)
        config = loader.load_configuration(command, line.split()[: -1 if last else None], RunMode.RUN)
        words = [word for word in words if not word.rstrip("=").endswith("schema")]
        return [_marked(word, config) for word in words if last.startswith("hydra") or not word.startswith("hydra")]
    return []


def _marked(word: str, config: DictConfig) -> str:
    """A candidate with "=" after a list, and a space after a whole word."""
    if word.endswith(".") and OmegaConf.is_list(OmegaConf.select(config, word[:-1])):
        return f"{word[:-1]}="
    return word if word.endswith((".", "=", "/")) else f"{word} "
