"""Makes environments: of one learner, as in the paper or with an inner loop, and of many learners."""

import dataclasses
from typing import TYPE_CHECKING, Any, Literal, overload

from mimic.base import compat
from mimic.envs import env_config
from mimic.envs.config import EnvConfig
from mimic.motions.demonstrations import Demonstrations

if TYPE_CHECKING:
    from mimic.envs.imitation import ImitationEnv
    from mimic.envs.many_arms import AnyArmEnv


@overload
def make(name: Literal["any_arm", "panda_family"], **overrides: Any) -> "AnyArmEnv": ...


@overload
def make(name: str, **overrides: Any) -> "ImitationEnv": ...


def make(name: str, **overrides: Any) -> "ImitationEnv | AnyArmEnv":
    """Makes an environment with its training demonstrations.

    Args:
      name: one of `environments()`. "panda_family" and "any_arm" draw another learner for each episode; these are an
        `AnyArmEnv`, all others an `ImitationEnv`.
      overrides: fields of the config, see `env_config`.

    Raises:
      ValueError: an unknown name or field, a value of the wrong type or out of range, demonstrations that do not fit.
    """
    config = env_config(name, **overrides)
    compat.import_mjx()  # takes seconds, as the imports below
    if config.kind == "sampled_arms":
        return make_family_env(config)
    return make_env(config)


def make_env(config: EnvConfig, demonstrations: Demonstrations | None = None) -> "ImitationEnv":
    """Makes the environment of a config with one learner: an `ImitationEnv`, or an object of a subclass of it.

    The subclass is `HardwareEnv` for the kind "inner_loop", or the registered class that the config names.

    Args:
      config: the config.
      demonstrations: motions to imitate. Default None: the training demonstrations of the config.

    Raises:
      ValueError: an unknown class, arms or demonstrations that do not fit, a reward term that fails.
    """
    from mimic.envs.imitation import ImitationEnv, env_class
    from mimic.envs.terms import check_reward_terms

    config.check_one_learner()
    make_class = env_class(config)
    if config.kind == "inner_loop":
        from mimic.envs.world_env import HardwareEnv

        if make_class is not ImitationEnv:
            raise ValueError(
                f"environment: expected none with an inner loop (control, world), got {config.environment!r}"
            )
        make_class = HardwareEnv
    env = make_class(config, demonstrations)
    check_reward_terms(env)
    return env


def make_family_env(config: EnvConfig, demonstrations: Demonstrations | None = None) -> "AnyArmEnv":
    """Makes the environment of a config whose learner is drawn for each episode.

    Args:
      config: the config.
      demonstrations: motions to imitate. Default None: the training demonstrations of the config.

    Raises:
      ValueError: settings that such an environment does not have, arms or demonstrations that do not fit.
    """
    from mimic.envs.family import arm_sampler, check_family
    from mimic.envs.imitation import training_and_held_out
    from mimic.envs.many_arms import AnyArmEnv

    check_family(config)
    sampler = arm_sampler(config)
    demonstrations = demonstrations or training_and_held_out(config)[0]
    return AnyArmEnv(dataclasses.replace(config, physics="fused"), sampler, demonstrations)
