"""The config of an environment: its kind, and values without effect."""

import pytest

import mimic
from mimic.envs.config import ArmsConfig
from mimic.physics.world import WorldConfig


def test_arms_and_world_choose_the_kind():
    assert mimic.env_config("panda4dof").kind == "one_arm"
    assert mimic.env_config("panda4dof", world="paper") == mimic.env_config("panda4dof")
    assert mimic.env_config("panda4dof", world="ideal").world == WorldConfig()
    assert mimic.env_config("panda4dof", world="ideal", control="joint_position").kind == "inner_loop"
    assert mimic.env_config("panda4dof", world={"payload": [0.0, 1.0]}).kind == "inner_loop"
    assert mimic.env_config("panda4dof", world="hardware").kind == "inner_loop"
    assert mimic.env_config("panda4dof", world="unknown").control == "torque"
    assert mimic.env_config("any_arm").kind == "sampled_arms"


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("any_arm", {"world": "nominal"}, "arms, world: expected one of them, got both"),
        ("panda4dof", {"control": "joint_velocity"}, "control: expected torque without an inner loop, got joint_vel"),
        ("any_arm", {"control": "joint_velocity"}, "control: expected torque without an inner loop, got joint_vel"),
        ("panda4dof", {"world": "nominal", "substeps": 20}, "substeps: expected none with an inner loop, .*, got 20"),
        ("panda4dof", {"limit_weight": 2.0}, "limit_weight: expected with limits=hardware, got 2.0"),
        ("panda4dof", {"demonstrations": {"path": "a.npz", "source": "b"}}, "expected path or source, got both"),
        (
            "panda4dof",
            {"demonstrations": {"path": "a.npz", "kind": "pid"}},
            "kind: expected none with a path",
        ),
        (
            "panda4dof",
            {"arms": {"most_locked": 3}},
            "arms: expected locked_fraction, perturbed_fraction or random_frac",
        ),
    ],
)
def test_values_without_effect_are_rejected(name, fields, message):
    with pytest.raises(ValueError, match=message):
        mimic.env_config(name, **fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "arms: expected locked_fraction, perturbed_fraction or random_fraction above 0"),
        ({"random_fraction": 1.0, "models": ["panda"]}, "arms: expected models and a perturbed_fraction above 0, or"),
        ({"perturbed_fraction": 1.0}, "arms: expected models and a perturbed_fraction above 0, or neither"),
        ({"random_fraction": 1.0, "unseen": ["2"]}, "arms.unseen: expected with a locked_fraction above 0"),
        ({"locked_fraction": 1.0, "unseen": ["two"]}, "arms.unseen: expected numbers of joints from 1"),
    ],
)
def test_arms_to_sample_are_checked(fields, message):
    with pytest.raises(ValueError, match=message):
        ArmsConfig(**fields)
