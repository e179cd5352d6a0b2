"""Arms by name, such as "ur5e", from model files that are on this machine. Nothing is downloaded, no package imported.

They are looked for in a clone of MuJoCo Menagerie that an environment variable names, in the package robosuite, and in
the folder where robot_descriptions keeps the models that it has downloaded.
"""

import importlib.util
import os
import re
from collections.abc import Iterator
from pathlib import Path

from mimic.base.config import suggestion

MENAGERIE = "MUJOCO_MENAGERIE"  # environment variable with the folder of a clone
_CACHE, _DEFAULT_CACHE = "ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions"  # of robot_descriptions
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
BUILT_IN = "panda", "planar", "panda_pair"  # mimic's own arms, which no other arm of the name replaces
_SHOWN = 30  # names in a message
_WAYS = (
    "install the package robosuite, load it once with robot_descriptions, or name a clone of mujoco_menagerie by the "
    f"environment variable {MENAGERIE}"
)


def is_arm_name(model: str) -> bool:
    """Whether a text is the name of an arm rather than of a file."""
    return _NAME.fullmatch(model) is not None and not os.path.lexists(model)


def named_arm(name: str) -> Path:
    """The model file of an arm.

    Raises:
      ValueError: there is no such arm on this machine. The line says how to get it.
    """
    arms = named_arms()
    if name in arms:
        return arms[name]
    listed = ", ".join(list(arms)[:_SHOWN]) + (", ..." if len(arms) > _SHOWN else "")
    here = f"here are {listed}{suggestion(name, arms)}" if arms else "here are none"
    raise ValueError(
        f"model: expected {', '.join(BUILT_IN)}, an MJCF or URDF file, or the name of an arm that is here, got "
        f"{name!r}; {_WAYS}; {here}"
    )


def named_arms() -> dict[str, Path]:
    """The arms that are on this machine by name; where several places have one, that of the first place."""
    arms: dict[str, Path] = {}
    for name, file in (*_menagerie(os.environ.get(MENAGERIE, "")), *_robosuite(), *_robot_descriptions()):
        arms.setdefault(name, file)
    return {name: file for name, file in sorted(arms.items()) if name not in BUILT_IN}


def _menagerie(folder: str) -> Iterator[tuple[str, Path]]:
    """The models of a clone of MuJoCo Menagerie: MAKER_MODEL/NAME.xml, without the scenes around them."""
    if folder:
        for file in sorted(Path(folder).expanduser().glob("*/*.xml")):
            if not file.name.startswith("scene"):
                yield file.stem, file


def _robosuite() -> Iterator[tuple[str, Path]]:
    """The robots of the package robosuite: NAME/robot.xml."""
    found = importlib.util.find_spec("robosuite")  # of a package itself, this imports nothing
    for folder in (found.submodule_search_locations or ()) if found else ():
        for file in sorted(Path(folder).glob("models/assets/robots/*/robot.xml")):
            yield file.parent.name, file


def _robot_descriptions() -> Iterator[tuple[str, Path]]:
    """The clones of MuJoCo Menagerie in the folder of robot_descriptions, of its own or of another commit."""
    cache = Path(os.environ.get(_CACHE) or _DEFAULT_CACHE).expanduser()
    for folder in (cache / "mujoco_menagerie", *sorted(cache.glob("mujoco_menagerie-*/mujoco_menagerie"))):
        yield from _menagerie(str(folder))
