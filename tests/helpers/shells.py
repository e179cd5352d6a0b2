"""Interactive shells in a pseudo-terminal, for the completion of their command lines."""

import os
import pty
import select
import subprocess
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

_PATIENCE = 60  # s
_KEY = b"\x14"  # Ctrl-T: prints the line, and clears it
_INTERACTIVE = {"bash": ["bash", "--norc", "--noprofile", "-i"], "zsh": ["zsh", "-f", "-i"]}
# The prompt is split, since the terminal echoes what is typed.
_SETTINGS = {
    "bash": (
        """show() { printf '[%s]' "[$READLINE_LINE]"; READLINE_LINE=; }; bind -x '"\\C-t": show'""",
        """eval "$(mimic completion bash)"; PS1=rea''dy""",
    ),
    "zsh": (
        """show() { print -r "[[$BUFFER]]"; BUFFER= }; zle -N show; bindkey '^T' show""",
        """autoload -U compinit; compinit -u -D; eval "$(mimic completion zsh)"; PS1=rea''dy""",
    ),
}


def lines_after_tab(shell: str, lines: Iterable[str], folder: Path, variables: Mapping[str, str]) -> list[str]:
    """The lines that an interactive bash or zsh has after the TAB key, without what it printed."""
    terminal, end = pty.openpty()
    variables = {**variables, "TERM": "dumb", "HOME": str(folder)}
    process = subprocess.Popen(
        _INTERACTIVE[shell], stdin=end, stdout=end, stderr=end, cwd=folder, env=variables, start_new_session=True
    )
    os.close(end)
    try:
        os.write(terminal, "".join(f"{setting}\n" for setting in _SETTINGS[shell]).encode())
        _read_until(terminal, b"ready")
        completed = []
        for line in lines:
            os.write(terminal, line.encode() + b"\t" + _KEY)
            completed.append(_read_until(terminal, b"]]").rpartition("[[")[2].partition("]]")[0])
        return completed
    finally:
        process.kill()
        process.wait()
        os.close(terminal)


def _read_until(terminal: int, end: bytes) -> str:
    read, deadline = b"", time.monotonic() + _PATIENCE
    while end not in read:
        if not select.select([terminal], [], [], max(0.0, deadline - time.monotonic()))[0]:
            raise TimeoutError(f"expected {end!r} within {_PATIENCE} s, got {read[-1000:]!r}")
        read += os.read(terminal, 4096)
    return read.decode()


def fish_candidates(line: str, folder: Path, variables: Mapping[str, str]) -> list[str]:
    """What fish proposes for the last word of a line."""
    script = "mimic completion fish | source; complete -C $argv[1]"
    command = ["fish", "--no-config", "-c", script, line]
    variables = {**variables, "HOME": str(folder)}
    result = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=True)
    return result.stdout.splitlines()
