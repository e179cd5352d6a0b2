"""Training of a pose mapper to any arm: each sample is another learner and another pose of an expert."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.sampler import Sampler
from mimic.trainers.pose_mapper.any_arm_model import AnyArmMapperModel, Params, expert_pose
from mimic.trainers.pose_mapper.training import Objective


def any_arm_objective(model: AnyArmMapperModel, sampler: Sampler) -> Objective:
    """The mean distance of the poses that a mapper proposes, before the Newton steps.

    A sample is a random key: arms and pose are drawn within the loss, so that an epoch needs no memory for its arms.

    Args:
      model: the mapper.
      sampler: draws the learners, and the experts where they are drawn.
    """
    draw_expert: Sampler = sampler if model.expert_is_drawn else lambda _: model.expert

    def distances(params: Params, keys: Array) -> Float[Array, "samples heads"]:
        def of_sample(key: Array) -> Float[Array, " heads"]:
            key_learner, key_pose, key_expert = jax.random.split(key, 3)
            learner, expert_arm = sampler(key_learner), draw_expert(key_expert)
            expert = expert_pose(expert_arm, random_pose(expert_arm, key_pose))
            return model.distances(expert, learner, model.candidates(params, expert, learner))

        return jax.vmap(of_sample)(keys)

    return Objective(model.init, jax.random.split, distances)


def random_pose(arm: ArmArrays, key: Array) -> Float[Array, " joints"]:
    """A pose [rad], uniform within the joints' ranges; locked joints are at home."""
    lower, upper = jnp.asarray(arm.joint_range, jnp.float32).T
    qpos = jax.random.uniform(key, lower.shape, jnp.float32, minval=lower, maxval=upper)
    return jnp.where(jnp.asarray(arm.is_free) > 0, qpos, jnp.asarray(arm.home, jnp.float32))
