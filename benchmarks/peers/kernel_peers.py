"""The function of the metric's kernel written the straightforward way, on 4x4 matrices, in JAX and in PyTorch."""

import gc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mimic

Function = Callable[..., Any]  # expert_qpos, expert_qvel, learner_qpos, learner_qvel -> distance


def jax_distance(*case: Any) -> Function:
    """The distance of one sample in JAX, to be batched by `jax.vmap`; arguments as of `motion_distance`."""
    distance = _distance(jnp, lambda x: jnp.asarray(x, jnp.float32), *case)

    def precise(*motion: jax.Array) -> jax.Array:
        with jax.default_matmul_precision("highest"):  # not TF32, which is 1e-3 off
            return distance(*motion)

    return precise


def torch_distance(*case: Any, device: str) -> Function:
    """The distance of a batch, [samples, joints], in PyTorch."""
    import torch  # pyright: ignore[reportMissingImports]

    return _distance(torch, lambda x: torch.as_tensor(x, dtype=torch.float32, device=device), *case)


def free_torch_memory() -> None:
    import torch  # pyright: ignore[reportMissingImports]

    gc.collect()
    torch.cuda.empty_cache()


def _distance(
    lib: Any, array: Function, expert: mimic.Embodiment, learner: mimic.Embodiment, matrix: np.ndarray, weights: Any
) -> Function:
    """The distance for any leading axes, by `jax.numpy` or `torch` and what makes its arrays from NumPy's."""
    expert_states, learner_states = (_link_states(lib, array, arm) for arm in (expert, learner))
    pairs = array(matrix)

    def norm(vectors: Any) -> Any:
        square = (vectors * vectors).sum(-1)
        return lib.where(square > 0, lib.sqrt(lib.where(square > 0, square, 1)), 0)

    def distance(*motion: Any) -> Any:
        states = zip(expert_states(*motion[:2]), learner_states(*motion[2:]), strict=True)
        position, direction, velocity, spin = ((a[..., :, None, :], b[..., None, :, :]) for a, b in states)
        total = 0.5 * np.pi * weights.rotation * (1 - (direction[0] * direction[1]).sum(-1))
        for name, (a, b) in {"translation": position, "linear_velocity": velocity, "angular_velocity": spin}.items():
            if getattr(weights, name):
                total = total + getattr(weights, name) * norm(a - b)
        return (pairs * total).mean((-2, -1))

    return distance


def _link_states(lib: Any, array: Function, arm: mimic.Embodiment) -> Function:
    """Positions, directions and velocities of the links, [..., links, 3], by T = exp(q1 S1) ... exp(qn Sn) M."""
    screws, homes = np.zeros((arm.num_joints, 4, 4)), np.tile(np.eye(4), (arm.num_links, 1, 1))
    screws[:, :3, :3] = np.cross(np.eye(3), np.asarray(arm.joint_axis)[:, None, :])
    screws[:, :3, 3] = np.cross(arm.joint_anchor, arm.joint_axis)
    homes[:, :3, :3], homes[:, :3, 3] = arm.link_rotation, arm.link_position
    axes, squares, zero_poses, identity = (array(x) for x in (screws, screws @ screws, homes, np.eye(4)))  # S^3 = -S
    parents, length = np.add(arm.link_joint, 1).tolist(), float(arm.chain_length)

    def states(qpos: Any, qvel: Any) -> tuple[Any, ...]:
        transform = lib.broadcast_to(identity, (*qpos.shape[:-1], 4, 4))
        transforms, rates = [transform], [lib.zeros_like(transform)]
        for joint in range(arm.num_joints):
            angle, speed = (x[..., joint, None, None] for x in (qpos, qvel))
            rotation = identity + lib.sin(angle) * axes[joint] + (1 - lib.cos(angle)) * squares[joint]
            transforms.append(transforms[-1] @ rotation)
            rates.append(rates[-1] @ rotation + speed * (transforms[-1] @ axes[joint]))
        frames, rates = (lib.stack([x[parent] for parent in parents], -3) @ zero_poses for x in (transforms, rates))
        spin = rates[..., :3, :3] @ lib.swapaxes(frames[..., :3, :3], -1, -2)
        angular = lib.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], -1)
        return frames[..., :3, 3] / length, frames[..., :3, 0], rates[..., :3, 3] / length, angular

    return states
