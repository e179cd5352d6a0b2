"""3. One arm holds a pose. Which pose of another arm is most like it?

    python examples/03_imitate_poses.py [FOLDER]

Compares what is obvious, what the paper does and the optimiser on 200 poses, and draws three of them.
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

import mimic

out = Path(sys.argv[1] if len(sys.argv) > 1 else time.strftime("examples_out/03_imitate_poses-%Y%m%d-%H%M%S"))
out.mkdir(parents=True, exist_ok=True)

# ---- The question ----------------------------------------------------------------------------------------------------
#
# The learner's pose of least embodiment distance to the expert's. Nothing moves, so velocities do not count; the
# positions and directions of the links do, equally, as in the environments. Example 1 is about what these words mean.

expert, learner = mimic.panda(), mimic.panda(locked=(3, 6, 7))
correspondence = mimic.arc_length_correspondence(expert, learner)
weights = mimic.DistanceWeights(translation=1.0, rotation=1.0)

lower, upper = expert.joint_range.T
poses = np.random.default_rng(0).uniform(lower, upper, (200, expert.num_joints)).astype(np.float32)


def mean_distance(learner_poses):
    """Of the 200 poses."""
    distance = jax.vmap(
        lambda qpos, learner_qpos: mimic.embodiment_distance(
            mimic.link_states(expert, qpos), mimic.link_states(learner, learner_qpos), correspondence, weights
        )
    )
    return float(distance(poses, learner_poses).mean())


# ---- Four answers ----------------------------------------------------------------------------------------------------
#
# A random pose is the scale. Copying the angles of the joints that both arms have is what one would try first: it is
# a third as bad, since a joint's angle means something else once its neighbours are locked. The paper descends from one
# start with a constant step. The optimiser descends from thirteen, with a Newton method that turns round where the
# distance is concave. `jax.jit` around it keeps the compiled program for the next poses of the same number.

lower, upper = learner.joint_range.T
random_poses = np.random.default_rng(1).uniform(lower, upper, (200, learner.num_joints)).astype(np.float32)
copied_poses = poses[:, [expert.joint_names.index(name) for name in learner.joint_names]]


@jax.jit
def descend(qpos):
    return mimic.imitate_pose(
        expert, learner, qpos, correspondence, weights, method="gradient_descent", starts=0, iterations=300
    )


@jax.jit
def imitate(qpos, key):
    return mimic.imitate_pose(expert, learner, qpos, correspondence, weights, key=key)


descended, found = descend(poses), imitate(poses, jax.random.key(0))
answers = {
    "random": random_poses,
    "copied angles": copied_poses,
    "gradient descent, one start": descended.qpos,
    "imitate_pose": found.qpos,
}

# The optimiser cannot prove that it found the least distance. Asking it again from other starts shows how often it did
# not: the best of nine searches is the best that is known.

searched = [imitate(poses, jax.random.key(seed)).distance for seed in range(1, 9)]
best = jnp.min(jnp.stack([found.distance, *searched]), axis=0)
scale = mean_distance(random_poses) - float(best.mean())

print(f"{'':28}  mean distance   share of the way from the best known (0) to a random pose (1)")
for name, answer in answers.items():
    distance = mean_distance(answer)
    print(f"{name:28}  {distance:13.4f}   {(distance - float(best.mean())) / scale:.2%}")
reached = float(jnp.mean(found.distance <= best + 1e-3 * float(best.mean())))
print(f"imitate_pose is at the best known pose in {reached:.1%}, one descent in "
      f"{float(jnp.mean(descended.distance <= best + 1e-3 * float(best.mean()))):.1%}")  # fmt: skip

# The best known distance is not 0: four joints cannot point seven links everywhere. No method can take that part away.

print(f"what remains of the distance at the best poses: {float(best.mean()):.4f}, "
      f"from {float(best.min()):.4f} to {float(best.max()):.4f}")  # fmt: skip

# ---- How fast? -------------------------------------------------------------------------------------------------------

began = time.perf_counter()
jax.block_until_ready(imitate(poses[::-1], jax.random.key(0)))
print(f"{len(poses) / (time.perf_counter() - began):,.0f} poses a second, once compiled")

# ---- A picture -------------------------------------------------------------------------------------------------------
#
# `ArmScene` draws arms side by side, with MuJoCo's renderer; locked joints are red. It needs no display. From left to
# right: the learner as the optimiser has it, the expert, and the learner with the copied angles. Nothing keeps random
# poses out of the floor, so three are drawn in which the expert stays above it.

heights = jax.vmap(lambda qpos: mimic.link_states(expert, qpos).position[:, 2].min())(poses)
above = [i for i in np.argsort(found.distance) if heights[i] > 0.1]
chosen = above[0], above[len(above) // 2], above[-1]  # the easiest, a usual one and the hardest
arms = [mimic.ArmConfig(locked=[3, 6, 7]), mimic.ArmConfig(), mimic.ArmConfig(locked=[3, 6, 7])]
with mimic.ArmScene(arms, width=1600, height=900) as scene:
    images = [scene.image([found.qpos[i], poses[i], copied_poses[i]])[180:720, 280:1320] for i in chosen]
figure, axes = plt.subplots(3, 1, figsize=(7.5, 12), layout="constrained")
for axis, image, i in zip(axes, images, chosen, strict=True):
    axis.imshow(image)
    axis.axis("off")
    axis.set_title(f"pose {i}: optimiser (distance {found.distance[i]:.3f}), expert, copied angles", fontsize=10)
figure.savefig(out / "poses.png", dpi=100)
print(f"results: {out}")
