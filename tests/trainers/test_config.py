"""Resolved configs of trainers."""

import math

import pytest

import mimic
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig
from mimic.trainers.make import make_trainer


def test_presets_follow_the_backend_and_the_environment():
    config = PPOConfig()
    envs = (
        mimic.env_config("panda4dof"),
        mimic.env_config("panda_family"),
        mimic.env_config("panda4dof", world="nominal"),
    )
    names = [config.resolve(backend, env=env).preset for env in envs for backend in ("cpu", "gpu")]
    assert names == ["cpu", "gpu", "any_arm_cpu", "any_arm", "inner_loop_cpu", "inner_loop"]
    family = TrainConfig(mimic.env_config("panda_family"), PPOConfig())
    assert family.resolve().trainer.network == "joints"  # type: ignore[attr-defined] - the settings of PPO
    for backend in ("cpu", "gpu"):
        assert PoseMapperConfig().resolve(backend, env=mimic.env_config("panda4dof")).preset == "large"


def test_the_network_of_joints_needs_a_drawn_learner():
    config = TrainConfig(mimic.env_config("planar4dof"), PPOConfig(network="joints"))
    with pytest.raises(ValueError, match="trainer.network: expected mlp for one learner, got joints"):
        make_trainer(config, None)


BAD = {
    "loop": (lambda: PPOConfig(loop="x"), "trainer.loop: expected one of mimic, brax, got 'x'"),
    "schedule": (
        lambda: PPOConfig(loop="brax").resolve("gpu"),
        "trainer.final_learning_rate: expected 1.0 with brax's loop, got 0.01",
    ),
    "num_envs": (lambda: PPOConfig(num_envs=500).resolve("cpu"), "must be a multiple of num_envs = 500"),
    "learning_rate": (
        lambda: PPOConfig(learning_rate=math.inf),
        "trainer.learning_rate: expected a number above 0 and at most 1, got inf",
    ),
    "rotation": (
        lambda: mimic.env_config("panda4dof", metric={"rotation": math.inf}),
        r"rotation: expected a number from 0 to 1e\+06, got inf",
    ),
    "link_lengths": (
        lambda: mimic.env_config("planar4dof", learner={"link_lengths": [0.5, 0.0]}),
        r"each from 0.001 to 100, got \[0.5, 0.0\]",
    ),
    "batch_size": (
        lambda: PoseMapperConfig(batch_size=1000).resolve("cpu"),
        "expected a divisor of samples = 65536, got 1000",
    ),
    "preset": (
        lambda: PoseMapperConfig(preset="any_arm").resolve("cpu"),
        "trainer.preset: expected one of auto, paper, large, got 'any_arm'",
    ),
    "heads": (lambda: PoseMapperConfig(heads=0), "trainer.heads: expected a whole number from 1 to 1,000, got 0"),
    "horizon": (
        lambda: TrainConfig(mimic.env_config("any_arm", horizon=10), PoseMapperConfig()).check_used(),
        "env.horizon: expected no change with trainer=pose_mapper, which simulates nothing, got 10",
    ),
    "inputs": (lambda: PoseMapperConfig(inputs="pixels").resolve("cpu"), "expected one of angles, link_states"),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD)
def test_bad_values_are_one_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)
