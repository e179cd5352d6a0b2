"""Keys of arms on the command line, with one meaning in all commands: expert=ARM, learner=ARM, and their fields.

An arm is named by a built-in arm, the name or file of a model, or an environment, whose arm it then is. Naming an arm
replaces all of the arm that the environment has, its locked joints included; other keys, such as learner.tip=NAME and
learner.locked=[3,6], change fields of it, in any order.
"""

import dataclasses
from collections.abc import Collection, Iterator, Sequence

from mimic.arms.arm import ArmConfig
from mimic.base.overrides import setting
from mimic.envs import env_config, environments

ROLES = ("expert", "learner")
_PREFIXES = {"train": "env.", "demonstrations": "env.", "retarget": "env.", "view": "env.", "inspect": ""}
_TEMPLATE = "pair"  # the environment whose arms are the user's


def expand_arms(arguments: Sequence[str], command: str) -> list[str]:
    """The arguments of a command with the keys of arms in Hydra's syntax; those that name an arm come first.

    Raises:
      ValueError: an environment that has no arms of its own.
    """
    if command not in _PREFIXES:
        return list(arguments)
    keys = {argument.partition("=")[0] for argument in arguments if "=" in argument}
    named: list[str] = []
    others: list[str] = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        name = key.removeprefix(_PREFIXES[command])
        role, dot, field = name.partition(".")
        if not equals or role not in ROLES:
            others.append(argument)
            continue
        full = f"{_PREFIXES[command]}{role}"
        if not dot and value == _TEMPLATE and sum(other in (role, full) for other in keys) > 1:
            continue  # the pair's arm is the one that another key names
        if dot or value.startswith(("{", "$")):
            others.append(f"{full}{dot}{field}={value}")
        else:
            named += _arm(full, role, value)
    return [*named, *others]


def check_no_arms(overrides: Sequence[str], reason: str, parts: Collection[str] = (*ROLES, "env")) -> None:
    """Raises a ValueError for the first override that sets a part of the environment which something else brings along.

    Args:
      overrides: of the command line, with keys of arms expanded or not.
      reason: what follows "expected none", such as "with run=".
      parts: "expert", "learner", and "env" for all else of the environment.
    """
    for override in overrides:
        key = override.partition("=")[0].lstrip("+")
        role = key.removeprefix("env.").partition(".")[0]
        part = role if role in ROLES else key.partition(".")[0]
        if part in parts:
            raise ValueError(f"{part}: expected none {reason}, which brings its own")


def _arm(key: str, role: str, value: str) -> Iterator[str]:
    """The overrides for all fields of an arm."""
    arm = ArmConfig()
    if value in environments():
        arm = arm_of_environment(role, value)
    fields = {field.name: getattr(arm, field.name) for field in dataclasses.fields(arm)}
    for name, entry in fields.items():
        is_text = name == "model" and value not in environments()
        yield f"{key}.model={value}" if is_text else setting(f"{key}.{name}", entry)


def arm_of_environment(role: str, name: str) -> ArmConfig:
    """The expert or the learner of an environment.

    Raises:
      ValueError: an environment that has no arms of its own, or as learner one that draws them.
    """
    if name == _TEMPLATE:
        raise ValueError(f"{role}: expected an arm, or an environment with arms of its own, got {name!r}")
    env = env_config(name)
    if role == "learner":
        env.check_one_learner()
    return getattr(env, role)
