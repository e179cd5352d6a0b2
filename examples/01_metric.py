"""1. How similar are two arms? Poses, motions, and which links correspond.

    python examples/01_metric.py [FOLDER]

Needs nothing but mimic. Writes a picture of the link distances into FOLDER (a new one in examples_out by default).
"""

import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no window: pictures go to files

import matplotlib.pyplot as plt
import numpy as np

import mimic

out = Path(sys.argv[1] if len(sys.argv) > 1 else time.strftime("examples_out/01_metric-%Y%m%d-%H%M%S"))
out.mkdir(parents=True, exist_ok=True)

# ---- Two embodiments -------------------------------------------------------------------------------------------------
#
# An embodiment is what the metric knows of an arm: a chain of revolute joints and links. Here the expert is a Panda,
# which has seven joints. The learner is a Panda whose joints 3, 6 and 7 are locked. Locking removes the joint and keeps
# the link: the learner has four joints and seven links. `planar_arm` and `load_mjcf` make other embodiments.

expert = mimic.panda()
learner = mimic.panda(locked=(3, 6, 7))

print("expert: ", ", ".join(expert.link_names))
print("learner:", ", ".join(learner.link_names))
print(f"length of the chain: {expert.chain_length:.3f} m and {learner.chain_length:.3f} m")

# ---- Link states -----------------------------------------------------------------------------------------------------
#
# Each link has a frame in its middle, with the x-axis along the link. The metric compares four quantities of each
# frame: position, direction, linear velocity and angular velocity. Positions and linear velocities are divided by the
# length of the chain, so an arm and its copy at another size are equal.

expert_qpos = np.array([0.3, 0.5, -0.2, -1.2, 0.4, 0.9, 0.0])  # rad, one for each joint
expert_qvel = np.array([0.5, 0.0, 0.0, -0.5, 0.0, 0.0, 0.0])  # rad/s
states = mimic.link_states(expert, expert_qpos, expert_qvel)
print("\ndirections of the expert's links, in the base frame:")
for name, direction in zip(expert.link_names, np.asarray(states.direction), strict=True):
    print(f"  {name}  " + "  ".join(f"{x:+.2f}" for x in direction))

small, large, pose = mimic.planar_arm([0.2, 0.1]), mimic.planar_arm([2.0, 1.0]), np.array([0.4, 0.8])
distances = mimic.link_distances(
    mimic.link_states(small, pose), mimic.link_states(large, pose), mimic.DistanceWeights(translation=1.0, rotation=1.0)
)
print("\nan arm and its copy at ten times the size, in the same pose: link distances", np.diag(distances).round(6))

# ---- Which links correspond ------------------------------------------------------------------------------------------
#
# A correspondence matrix W weights each pair of links. The default of all environments, `arc_length_correspondence`,
# lays both chains on [0, 1] and weights a pair by the length of its overlap. For two Pandas, each link corresponds to
# itself, weighted by its length. This W does not depend on the pose, so the distance has fewer local minima than with
# `hard_correspondence` (nearest neighbours) or `soft_correspondence` (a softmax), which depend on the link distances.

correspondence = mimic.arc_length_correspondence(expert, learner)
print("\ncorrespondence by arc length (rows: expert, columns: learner)")
print(np.asarray(correspondence).round(2))

# ---- From link distances to one number -------------------------------------------------------------------------------
#
# The distance of two links is a weighted sum of four parts: translation (in chain lengths), rotation (an angle, 0 to
# pi), linear velocity and angular velocity. The embodiment distance is the mean of the elementwise product of W and the
# link distances. The simplest imitation copies the angles of the joints that both arms have:

shared = [expert.joint_names.index(name) for name in learner.joint_names]
copied = mimic.link_states(learner, expert_qpos[shared], expert_qvel[shared])

PARTS = {
    "translation": mimic.DistanceWeights(translation=1.0, rotation=0.0),
    "rotation": mimic.DistanceWeights(translation=0.0, rotation=1.0),
    "linear_velocity": mimic.DistanceWeights(rotation=0.0, linear_velocity=1.0),
    "angular_velocity": mimic.DistanceWeights(rotation=0.0, angular_velocity=1.0),
}
print("\nembodiment distance of the copied joint angles, by part:")
for name, weights in PARTS.items():
    print(f"  {name:16}  {mimic.embodiment_distance(states, copied, correspondence, weights):.4f}")

# The parts have different scales: a rotation is at most 3.1, a translation hardly more than 1. The weights define what
# "similar" means. The paper's, used below, are rotation 1, angular velocity 0.01, linear velocity 0.001 and
# translation 0. The default of the commands also has a translation weight of 1, with which arms look more similar.

paper = mimic.embodiment_distance(states, copied, correspondence, mimic.PAPER_WEIGHTS)
print(f"under the paper's weights: {paper:.4f}")

# ---- Which link contributes most? ------------------------------------------------------------------------------------
#
# The embodiment distance is a sum over pairs of links. The sum over the expert's links is the contribution of each link
# of the learner. The contributions add up to the distance.

pairs = mimic.link_distances(states, copied, mimic.PAPER_WEIGHTS)
contributions = np.asarray(correspondence * pairs).sum(axis=0) / pairs.size
print("\ncontribution of each link of the learner:")
for name, contribution in zip(learner.link_names, contributions, strict=True):
    print(f"  {name:18}  {contribution:.4f}  ({contribution / paper:.0%})")
print(f"  sum                 {contributions.sum():.4f}")

# ---- Is the distance small? ------------------------------------------------------------------------------------------
#
# Two other distances give it a scale: that of a learner which holds its start pose, here the zero pose, and the minimum
# over all poses and velocities of this learner. `kinematic_bound` computes the latter for each time step of a motion
# independently; here the motion has one step. It optimises from several initial guesses, so in principle it may miss
# the global minimum.

rest = mimic.embodiment_distance(states, mimic.link_states(learner, np.zeros(4)), correspondence, mimic.PAPER_WEIGHTS)
bound = mimic.kinematic_bound(
    expert, learner, expert_qpos[None], expert_qvel[None], correspondence, mimic.PAPER_WEIGHTS
)[0]
gap = (paper - bound) / (rest - bound)
print(f"\nholding the start pose: {rest:.4f}   copied angles: {paper:.4f}   kinematic bound: {bound:.4f}")
print(f"optimality gap of the copied angles, 0 for the bound and 1 for holding the start pose: {gap:.0%}")

# ---- A picture -------------------------------------------------------------------------------------------------------

figure, axes = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
for axis, matrix, title in zip(axes, (correspondence, pairs), ("correspondence", "link distances"), strict=True):
    image = axis.imshow(np.asarray(matrix), cmap="Blues", vmin=0)
    axis.set_xticks(range(learner.num_links), learner.link_names, rotation=30, ha="right")
    axis.set_yticks(range(expert.num_links), expert.link_names)
    axis.set(xlabel="learner", ylabel="expert", title=title)
    figure.colorbar(image, ax=axis, shrink=0.8)
figure.savefig(out / "links.png", dpi=100)
print(f"\nresults: {out}")
