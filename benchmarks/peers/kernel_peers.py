"""The function of the metric's kernel written the straightforward way, on 4x4 matrices, in JAX and in PyTorch."""

import gc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mimic

Function = Callable[..., Any]  # expert_qpos, expert_qvel, learner_qpos, learner_qvel -> distance(s)


def jax_distance(*case: Any) -> Function:
    """The distance of one sample in JAX; to be batched by `jax.vmap`."""
    distance = _matrix_distance(jnp, lambda x: jnp.asarray(x, jnp.float32), *case)

    def precise(*motion: jax.Array) -> jax.Array:
        with jax.default_matmul_precision("highest"):  # not TF32, which is 1e-3 off
            return distance(*motion)

    return precise


def torch_distance(*case: Any, device: str) -> Function:
    """The distance of a batch, [samples, joints], in PyTorch."""
    import torch  # pyright: ignore[reportMissingImports]

    def constant(values: Any) -> Any:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

    return _matrix_distance(torch, constant, *case)


def _matrix_distance(
    lib: Any,
    constant: Callable[[Any], Any],
    expert: mimic.Embodiment,
    learner: mimic.Embodiment,
    matrix: np.ndarray,
    weights: mimic.DistanceWeights,
) -> Function:
    """The embodiment distance for any leading axes.

    Twists are matrices too: with T = exp(q1 S1) ... exp(qn Sn) M, dT/dt T^-1 is the sum of the joints' velocities times
    their adjoint axes.

    Args:
      lib: `jax.numpy` or `torch`.
      constant: makes an array of that library from one of NumPy.
      expert, learner: the arms.
      matrix: [expert links, learner links] correspondence.
      weights: constants.
    """

    def link_states(arm: mimic.Embodiment) -> Function:
        screws = _screws(arm)
        axes, squares, homes = (constant(x) for x in (screws, screws @ screws, _homes(arm)))
        identity, parents, length = constant(np.eye(4)), np.add(arm.link_joint, 1).tolist(), float(arm.chain_length)

        def states(qpos: Any, qvel: Any) -> tuple[Any, ...]:
            transform = lib.broadcast_to(identity, (*qpos.shape[:-1], 4, 4))
            transforms, twists = [transform], [lib.zeros_like(transform)]
            for joint in range(arm.num_joints):
                angle, speed = (x[..., joint, None, None] for x in (qpos, qvel))
                twists.append(twists[-1] + speed * (transform @ axes[joint] @ inverse(transform)))
                transform = transform @ (identity + lib.sin(angle) * axes[joint] + (1 - lib.cos(angle)) * squares[joint])
                transforms.append(transform)
            twist = lib.stack([twists[parent] for parent in parents], -3)
            frames = lib.stack([transforms[parent] for parent in parents], -3) @ homes
            angular = lib.stack([twist[..., 2, 1], twist[..., 0, 2], twist[..., 1, 0]], -1)
            return frames[..., :3, 3] / length, frames[..., :3, 0], (twist @ frames)[..., :3, 3] / length, angular

        return states

    def inverse(transform: Any) -> Any:
        back = lib.swapaxes(transform[..., :3, :3], -1, -2)
        rows = lib.concatenate([back, -back @ transform[..., :3, 3:]], -1)
        return lib.concatenate([rows, transform[..., 3:, :]], -2)

    def norm(vectors: Any) -> Any:
        square = (vectors * vectors).sum(-1)
        return lib.where(square > 0, lib.sqrt(lib.where(square > 0, square, 1)), 0)

    expert_states, learner_states, pairs = link_states(expert), link_states(learner), constant(matrix)

    def distance(*motion: Any) -> Any:
        states = expert_states(*motion[:2]), learner_states(*motion[2:])
        positions, directions, velocities, spins = ((a[..., :, None, :], b[..., None, :, :]) for a, b in zip(*states))
        total = 0.5 * np.pi * weights.rotation * (1 - (directions[0] * directions[1]).sum(-1))
        for weight, (a, b) in (
            (weights.translation, positions),
            (weights.linear_velocity, velocities),
            (weights.angular_velocity, spins),
        ):
            if weight:
                total = total + weight * norm(a - b)
        return (pairs * total).mean((-2, -1))

    return distance


def free_torch_memory() -> None:
    """Returns the GPU memory that PyTorch caches."""
    import torch  # pyright: ignore[reportMissingImports]

    gc.collect()
    torch.cuda.empty_cache()


def _screws(arm: mimic.Embodiment) -> np.ndarray:
    """The joints' axes in the zero pose as matrices of se(3), [joints, 4, 4]; S^3 = -S, as all joints are revolute."""
    screws = np.zeros((arm.num_joints, 4, 4))
    screws[:, :3, :3] = np.cross(np.eye(3), np.asarray(arm.joint_axis)[:, None, :])
    screws[:, :3, 3] = np.cross(arm.joint_anchor, arm.joint_axis)
    return screws


def _homes(arm: mimic.Embodiment) -> np.ndarray:
    """The link frames in the zero pose, [links, 4, 4]."""
    homes = np.tile(np.eye(4), (arm.num_links, 1, 1))
    homes[:, :3, :3], homes[:, :3, 3] = arm.link_rotation, arm.link_position
    return homes
