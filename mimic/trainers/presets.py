"""Presets of the trainers: the values of the fields of `PPOConfig` and `PoseMapperConfig` that are None."""

from typing import Any

from mimic.envs.config import Kind

PPO_PRESETS: dict[str, dict[str, Any]] = {
    # Two cores: few environments and many gradient steps on each sample, because the physics takes most of the time.
    "cpu": {
        "num_timesteps": 3_000_000,
        "num_envs": 512,
        "unroll_length": 10,
        "batch_size": 128,
        "num_minibatches": 32,
        "num_updates_per_batch": 8,
        "learning_rate": 1e-3,
        "final_learning_rate": 0.05,
        "discounting": 0.7,
        "entropy_cost": 0.01,
        "final_entropy_cost": 1.0,
        "network": "mlp",
        "hidden_layers": [128, 128],
        "crossovers": 4000,
        "displaced_crossovers": 0.4,
        "evaluations": 10,
    },
    # One GPU: enough environments to keep it busy. The high entropy cost makes the arm explore other pose branches.
    "gpu": {
        "num_timesteps": 150_000_000,
        "num_envs": 4096,
        "unroll_length": 10,
        "batch_size": 512,
        "num_minibatches": 32,
        "num_updates_per_batch": 4,
        "learning_rate": 1e-3,
        "final_learning_rate": 0.01,
        "discounting": 0.9,
        "entropy_cost": 0.1,
        "final_entropy_cost": 0.05,
        "network": "mlp",
        "hidden_layers": [512, 256],
        "crossovers": 8000,
        "displaced_crossovers": 0.4,
        "evaluations": 8,
    },
}
# Where the learner is drawn for each episode, an untrained policy is a good controller already: small steps, without a
# reward for noise, and a long horizon, because it pays off late to move to another minimum of the metric.
_OF_SAMPLED_ARMS = {
    "network": "joints",
    "learning_rate": 3e-4,
    "final_learning_rate": 0.1,
    "discounting": 0.97,
    "entropy_cost": 0.0,
    "final_entropy_cost": 1.0,
    "displaced_crossovers": 0.0,  # the learner starts at home
}
# With an inner loop episodes start in the ready pose. A smaller learning rate ends with a smaller gap (measured), and
# delays need a longer horizon.
_OF_INNER_LOOP = {"learning_rate": 3e-4, "discounting": 0.9, "entropy_cost": 0.02, "displaced_crossovers": 0.0}
# The presets of each kind of environment, on the backends cpu and gpu.
PPO_PRESETS_OF: dict[Kind, tuple[str, str]] = {
    "one_arm": ("cpu", "gpu"),
    "sampled_arms": ("any_arm_cpu", "any_arm"),
    "inner_loop": ("inner_loop_cpu", "inner_loop"),
}
_CHANGES_OF: dict[Kind, dict[str, Any]] = {"sampled_arms": _OF_SAMPLED_ARMS, "inner_loop": _OF_INNER_LOOP}
for _kind, _changes in _CHANGES_OF.items():
    for _name, _base in zip(PPO_PRESETS_OF[_kind], PPO_PRESETS_OF["one_arm"], strict=True):
        PPO_PRESETS[_name] = {**PPO_PRESETS[_base], **_changes}
# One arm: with 4,000 crossovers held-out motions more often end in another basin of the metric.
PPO_PRESETS["cpu"] |= {"num_updates_per_batch": 6, "crossovers": 12_000}
PPO_PRESETS["any_arm_cpu"] |= {"num_timesteps": 600_000, "evaluations": 5}  # eleven minutes on two cores
# 0.6 million arms; from 12 to 22 million steps on nothing changed.
PPO_PRESETS["any_arm"] |= {"num_timesteps": 30_000_000}
# Layers twice as wide have about the same gap (docs/hardware_world.md), and a robot's computer takes longer for them.
PPO_PRESETS["inner_loop"] |= {"num_timesteps": 120_000_000, "hidden_layers": [256, 128]}

MAPPER_PRESETS: dict[str, dict[str, Any]] = {
    # Network, training set and minibatches are the paper's. The paper does not state optimiser, rate, epochs, patience.
    "paper": {
        "inputs": "angles",
        "outputs": "tanh",
        "heads": 1,
        "hidden_layers": [32, 32, 32],
        "activation": "leaky_relu",
        "samples": 1024,
        "batch_size": 32,
        "fresh": False,
        "epochs": 2000,
        "learning_rate": 1e-3,
        "final_learning_rate": 1.0,
        "patience": 10,
        "evaluations": 100,
        "held_out_poses": 10_000,
    },
    # The best by measurement, both on a GPU and on two cores.
    "large": {
        "inputs": "link_states",
        "outputs": "circle",
        "heads": 4,
        "hidden_layers": [128, 128, 128],
        "activation": "gelu",
        "samples": 65_536,
        "batch_size": 512,
        "fresh": True,
        "epochs": 30,
        "learning_rate": 2e-3,
        "final_learning_rate": 1e-3,
        "patience": 0,
        "evaluations": 10,
        "held_out_poses": 10_000,
    },
}
