"""What the metric's kernel is measured against: the same function, written the straightforward way."""

import gc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mimic

Function = Callable[..., Any]  # expert_qpos, expert_qvel, learner_qpos, learner_qvel -> distance(s)


def matrix_distance(
    expert: mimic.Embodiment, learner: mimic.Embodiment, matrix: np.ndarray, weights: mimic.DistanceWeights
) -> Function:
    """JAX on 4x4 matrices, one sample; to be batched by `jax.vmap`.

    Twists are matrices too: with T = exp(q1 S1) ... exp(qn Sn) M, dT/dt T^-1 is the sum of the joints' velocities times
    their adjoint axes.
    """

    def states(arm: mimic.Embodiment, qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, ...]:
        axes = jnp.asarray(_screws(arm), qpos.dtype)
        homes = jnp.asarray(_homes(arm), qpos.dtype)
        transform = jnp.eye(4, dtype=qpos.dtype)
        twist = jnp.zeros((4, 4), qpos.dtype)
        transforms, twists = [transform], [twist]
        for joint in range(arm.num_joints):
            twist = twist + qvel[joint] * _matmul(_matmul(transform, axes[joint]), _inverse(transform))
            transform = _matmul(transform, _exponential(axes[joint], qpos[joint]))
            transforms.append(transform)
            twists.append(twist)
        moved = np.asarray(arm.link_joint) + 1
        frames = _matmul(jnp.stack(transforms)[moved], homes)
        velocities = _matmul(jnp.stack(twists)[moved], frames)  # dT/dt
        spin = jnp.stack(twists)[moved]
        angular = jnp.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=-1)
        length = arm.chain_length
        return frames[:, :3, 3] / length, frames[:, :3, 0], velocities[:, :3, 3] / length, angular

    def distance(*motion: jax.Array) -> jax.Array:
        pair = states(expert, *motion[:2]), states(learner, *motion[2:])
        apart = [a[:, None, :] - b[None, :, :] for a, b in zip(*pair, strict=True)]
        cosine = jnp.einsum("ik,jk->ij", pair[0][1], pair[1][1], precision=jax.lax.Precision.HIGHEST)
        parts = {
            "translation": _norm(apart[0]),
            "rotation": 0.5 * jnp.pi * (1 - cosine),
            "linear_velocity": _norm(apart[2]),
            "angular_velocity": _norm(apart[3]),
        }
        total = sum(getattr(weights, name) * part for name, part in parts.items())
        return jnp.mean(jnp.asarray(matrix, cosine.dtype) * total)

    return distance


def torch_distance(
    expert: mimic.Embodiment,
    learner: mimic.Embodiment,
    matrix: np.ndarray,
    weights: mimic.DistanceWeights,
    device: str,
) -> Function:
    """The same in PyTorch, of batches [samples, joints]."""
    import torch  # pyright: ignore[reportMissingImports]

    def constant(values: Any) -> Any:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

    def prepared(arm: mimic.Embodiment) -> tuple[Any, ...]:
        screws = _screws(arm)
        return constant(screws), constant(screws @ screws), constant(_homes(arm)), np.add(arm.link_joint, 1).tolist()

    def states(arm: mimic.Embodiment, known: tuple[Any, ...], qpos: Any, qvel: Any) -> tuple[Any, ...]:
        axes, squares, homes, moved = known
        identity = torch.eye(4, device=device)
        transform = identity.expand(len(qpos), 4, 4)
        twist = torch.zeros_like(transform)
        transforms, twists = [transform], [twist]
        for joint in range(arm.num_joints):
            rotation, shift = transform[:, :3, :3], transform[:, :3, 3:]
            back = rotation.transpose(1, 2)
            inverse = torch.cat([torch.cat([back, -back @ shift], 2), transform[:, 3:]], 1)
            twist = twist + qvel[:, joint, None, None] * (transform @ axes[joint] @ inverse)
            sine, versine = torch.sin(qpos[:, joint]), 1 - torch.cos(qpos[:, joint])
            turn = identity + sine[:, None, None] * axes[joint] + versine[:, None, None] * squares[joint]
            transform = transform @ turn
            transforms.append(transform)
            twists.append(twist)
        spin = torch.stack(twists, 1)[:, moved]
        frames = torch.stack(transforms, 1)[:, moved] @ homes
        velocities = spin @ frames
        angular = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], -1)
        length = float(arm.chain_length)
        return frames[..., :3, 3] / length, frames[..., :3, 0], velocities[..., :3, 3] / length, angular

    known = prepared(expert), prepared(learner)
    pairs = constant(matrix)

    def distance(*motion: Any) -> Any:
        pair = states(expert, known[0], *motion[:2]), states(learner, known[1], *motion[2:])
        apart = [a[:, :, None, :] - b[:, None, :, :] for a, b in zip(*pair, strict=True)]
        cosine = (pair[0][1][:, :, None, :] * pair[1][1][:, None, :, :]).sum(-1)
        total = 0.5 * np.pi * weights.rotation * (1 - cosine)
        for name, index in (("translation", 0), ("linear_velocity", 2), ("angular_velocity", 3)):
            if getattr(weights, name):
                total = total + getattr(weights, name) * torch.linalg.vector_norm(apart[index], dim=-1)
        return (pairs * total).mean((1, 2))

    return distance


def give_memory_back() -> None:
    """What PyTorch keeps for its next tensors."""
    import torch  # pyright: ignore[reportMissingImports]

    gc.collect()
    torch.cuda.empty_cache()


def _screws(arm: mimic.Embodiment) -> np.ndarray:
    """The joints' axes in the zero pose as matrices of se(3), [joints, 4, 4]; S^3 = -S, as none of them moves along."""
    screws = np.zeros((arm.num_joints, 4, 4))
    screws[:, :3, :3] = np.cross(np.eye(3), np.asarray(arm.joint_axis)[:, None, :])
    screws[:, :3, 3] = np.cross(arm.joint_anchor, arm.joint_axis)
    return screws


def _homes(arm: mimic.Embodiment) -> np.ndarray:
    """The link frames in the zero pose, [links, 4, 4]."""
    homes = np.tile(np.eye(4), (arm.num_links, 1, 1))
    homes[:, :3, :3], homes[:, :3, 3] = arm.link_rotation, arm.link_position
    return homes


def _exponential(screw: jax.Array, angle: jax.Array) -> jax.Array:
    identity = jnp.eye(4, dtype=angle.dtype)
    return identity + jnp.sin(angle) * screw + (1 - jnp.cos(angle)) * _matmul(screw, screw)


def _inverse(transform: jax.Array) -> jax.Array:
    back = transform[:3, :3].T
    return transform.at[:3, :3].set(back).at[:3, 3].set(-_matmul(back, transform[:3, 3]))


def _matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)  # not TF32, which is 1e-3 off


def _norm(vectors: jax.Array) -> jax.Array:
    square = jnp.sum(vectors * vectors, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
