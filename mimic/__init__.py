"""mimic: a metric between robot arms of different kinematics, and imitation learning with it, in JAX and MJX.

The core functions are pure and take one sample; batch them with `jax.vmap`.
"""

from mimic.runs import signals

if signals.runs_as_command():  # a command ends in one line from here on: the imports below take a second
    signals.watch_signals()

import lazy_loader  # noqa: E402

from mimic.base import compat  # noqa: E402
from mimic.base.distribution import VERSION  # noqa: E402

compat.prepare_cpu()  # before JAX starts its backend: see mimic.base.compat

# The public names are in `__init__.pyi`, which type checkers read too. They are imported at the first access: JAX,
# MuJoCo and brax take seconds, and `mimic.deploy` needs none of them.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = VERSION
