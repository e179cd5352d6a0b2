"""Modules of a package that are imported at the first access, so that `import mimic` alone offers them."""

import pkgutil
from collections.abc import Callable, Iterable
from typing import Any

import lazy_loader


def modules_of(package: str, path: Iterable[str]) -> Callable[[str], Any]:
    """Returns the `__getattr__` of a package that imports its modules by name.

    Args:
      package: `__name__` of the package.
      path: its `__path__`.
    """
    getter, _, _ = lazy_loader.attach(package, [module.name for module in pkgutil.iter_modules(path)])
    return getter
