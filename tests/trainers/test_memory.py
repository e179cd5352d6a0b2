"""Trainings that cannot fit into the memory are rejected before anything is built."""

import dataclasses
from typing import Any

import pytest

from mimic.base.memory import check_memory, device_memory, host_memory
from mimic.envs import env_config
from mimic.trainers import memory
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig

GIB = 2**30


def check_training_memory(config):
    memory.check_training_memory(config.resolve())


@pytest.fixture
def small(monkeypatch):
    """A device with 1 GiB of memory."""
    monkeypatch.setattr(memory, "device_memory", lambda: GIB)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    ("trainer", "message"),
    [
        (PPOConfig(hidden_layers=[8192, 8192]), "trainer.hidden_layers: expected to fit"),
        (PPOConfig(unroll_length=1000), "trainer.batch_size, trainer.num_minibatches, trainer.unroll_length: expected"),
        (PPOConfig(num_envs=2**20, batch_size=2**15), "the device, 1.0 GiB; got a need of at least"),
        (PoseMapperConfig(hidden_layers=[8192, 8192]), "trainer.hidden_layers, trainer.heads: expected to fit"),
        (
            PoseMapperConfig(samples=2**26),
            "trainer.samples, trainer.validation_poses, trainer.held_out_poses: expected",
        ),
        (PoseMapperConfig(samples=2**20, batch_size=2**20), "trainer.batch_size, trainer.hidden_layers: expected"),
    ],
)
def test_large_sizes_are_rejected(trainer, message):
    with pytest.raises(ValueError, match=message):
        check_training_memory(TrainConfig(env_config("panda4dof"), trainer))


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("trainer", [PPOConfig(preset="cpu"), PoseMapperConfig(), PoseMapperConfig(preset="paper")])
def test_presets_are_accepted(trainer):
    check_training_memory(TrainConfig(env_config("panda4dof"), trainer))


def test_the_preset_of_gpus_fits_into_16_gib(monkeypatch):
    monkeypatch.setattr(memory, "device_memory", lambda: 16 * GIB)
    check_training_memory(TrainConfig(env_config("panda7dof"), PPOConfig(preset="gpu")))


def test_demonstrations_need_memory_of_the_host(monkeypatch):
    monkeypatch.setattr(memory, "host_memory", lambda: 10_000)
    env = env_config("planar4dof")
    with pytest.raises(ValueError, match=r"env.demonstrations.count, env.horizon: expected .* memory of the host"):
        check_training_memory(TrainConfig(env, PPOConfig()))
    stored = dataclasses.replace(env, demonstrations=dataclasses.replace(env.demonstrations, path="file.npz"))
    check_training_memory(TrainConfig(stored, PPOConfig()))


def test_the_memory_of_this_machine_is_known():
    assert (host_memory() or 0) > 2**28 and device_memory() == host_memory()


def test_unknown_memory_is_accepted():
    check_memory("trainer.num_envs", 1e30, None, "device")


@pytest.mark.usefixtures("small")
def test_large_mappers_to_any_arm_are_rejected():
    cases: list[tuple[dict[str, Any], str]] = [
        ({"width": 2**13, "layers": 3}, "trainer.width, trainer.layers: expected to fit"),
        ({"samples": 2**20, "batch_size": 2**20}, "trainer.batch_size, trainer.width, trainer.layers: expected"),
        (
            {"guesses": 1000, "held_out_poses": 2**10},
            "trainer.held_out_poses, trainer.heads, trainer.guesses: expected",
        ),
    ]
    for settings, message in cases:
        with pytest.raises(ValueError, match=message):
            check_training_memory(TrainConfig(env_config("any_arm"), PoseMapperConfig(**settings)))
