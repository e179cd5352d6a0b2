"""XLA's choices of matrix products on a GPU, kept with a run.

XLA measures which product of each shape is the fastest, and different ones round differently. JAX keeps the choices in
the compilation cache; a run keeps them too, so that it resumes to the bit where that cache is another one.
"""

import base64
import binascii
import hashlib
import json
import re
import sys
from pathlib import Path

import jax

from mimic.base.compilation import compilation_cache
from mimic.base.files import read_bytes, read_json, write_atomically

FILE = "autotuning.json"
_FOLDER = "xla_gpu_per_fusion_autotune_cache_dir"  # JAX's name for it in the compilation cache
_NAME = re.compile(r"\w[\w.-]*(/\w[\w.-]*)*")  # of a file in that folder

Choices = dict[str, bytes]  # content of a file by its name


def keep_choices(run_dir: Path) -> None:
    """Writes XLA's choices into a run directory; adds to those that are there. Nothing on CPUs or without a cache."""
    cache = compilation_cache()
    choices = _choices_in(cache / _FOLDER) if cache else {}
    kept = _kept_choices(run_dir)
    if choices.keys() - kept.keys():
        merged = {name: base64.b64encode(content).decode() for name, content in sorted({**choices, **kept}.items())}
        write_atomically(run_dir / FILE, json.dumps(merged, indent=0))


def use_kept_choices(run_dir: Path) -> None:
    """Lets XLA make the choices that a run keeps, if it keeps any.

    Where the compilation cache lacks some of them or has others, a cache inside it is used that starts with them.
    """
    cache, kept = compilation_cache(), _kept_choices(run_dir)
    if not cache or not kept:
        return
    present = _choices_in(cache / _FOLDER)
    if any(present.get(name) != content for name, content in kept.items()):
        digest = hashlib.sha256(repr(sorted(kept.items())).encode()).hexdigest()[:16]
        cache = cache / f"autotuning_{digest}"
        for name, content in kept.items():
            path = cache / _FOLDER / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        jax.config.update("jax_compilation_cache_dir", str(cache))


def _choices_in(folder: Path) -> Choices:
    return {path.relative_to(folder).as_posix(): read_bytes(path) for path in folder.rglob("*") if path.is_file()}


def _kept_choices(run_dir: Path) -> Choices:
    """Those in a run directory; none, with a warning, where they cannot be read."""
    try:
        encoded = read_json(run_dir / FILE)
        if not all(_NAME.fullmatch(name) and isinstance(value, str) for name, value in encoded.items()):
            raise ValueError("expected file names and base64")
        return {name: base64.b64decode(value, validate=True) for name, value in encoded.items()}
    except FileNotFoundError:
        return {}
    except (ValueError, binascii.Error) as error:
        print(
            f"warning: {str(run_dir / FILE)!r} is not used: {error}; XLA chooses matrix products anew", file=sys.stderr
        )
        return {}
