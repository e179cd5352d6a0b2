"""Makes environments: of one learner, as in the paper or with an inner loop, and of many learners."""

from typing import TYPE_CHECKING, Any

from mimic.base import compat
from mimic.envs import env_config
from mimic.envs.config import EnvConfig
from mimic.motions.demonstrations import Demonstrations

if TYPE_CHECKING:
    from mimic.envs.imitation import ImitationEnv


def make(name: str, **overrides: Any) -> "ImitationEnv":
    """Makes an environment with its training demonstrations.

    Args:
      name: one of `environments()`. "panda_family" and "any_arm" draw another learner for each episode, see
        `AnyArmEnv`.
      overrides: fields of the config, see `env_config`.

    Raises:
      ValueError: an unknown name or field, a value of the wrong type or out of range, demonstrations that do not fit.
    """
    config = env_config(name, **overrides)
    compat.import_mjx()  # takes seconds, as the imports below
    return make_env(config)


def make_env(config: EnvConfig, demonstrations: Demonstrations | None = None) -> "ImitationEnv":
    """Makes the environment of a config: an `ImitationEnv`, or an object of a subclass of it.

    The subclass is `HardwareEnv` for the kind "inner_loop", `AnyArmEnv` for "sampled_arms", or the registered class
    that the config names.

    Args:
      config: the config.
      demonstrations: motions to imitate. Default None: the training demonstrations of the config.

    Raises:
      ValueError: an unknown class, arms or demonstrations that do not fit, a reward term that fails.
    """
    from mimic.envs.imitation import ImitationEnv, env_class
    from mimic.envs.terms import check_reward_terms

    make_class = env_class(config)
    if config.kind == "inner_loop":
        from mimic.envs.world_env import HardwareEnv

        if make_class is not ImitationEnv:
            raise ValueError(
                f"environment: expected none with an inner loop (control, world), got {config.environment!r}"
            )
        make_class = HardwareEnv
    elif config.kind == "sampled_arms":
        from mimic.envs.many_arms import AnyArmEnv

        make_class = AnyArmEnv
    env = make_class(config, demonstrations)
    check_reward_terms(env)
    return env
