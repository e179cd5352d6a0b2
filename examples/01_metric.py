"""1. How alike are two arms? Poses, motions, and which links belong together.

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
# An embodiment is what the metric knows of an arm: a chain of hinges and links. Here the expert is a Panda, which has
# seven joints. The learner is a Panda whose joints 3, 6 and 7 are locked. Locking removes a joint and no link: it has
# four joints and seven links. `planar_arm` and `load_mjcf` make other embodiments.

expert = mimic.panda()
learner = mimic.panda(locked=(3, 6, 7))

print("expert: ", ", ".join(expert.link_names))
print("learner:", ", ".join(learner.link_names))
print(f"length of the chain: {expert.chain_length:.3f} m and {learner.chain_length:.3f} m")

# ---- Link states -----------------------------------------------------------------------------------------------------
#
# A frame sits in the middle of each link, its x-axis along the link. The metric compares four things of each frame:
# where it is, where the link points, and how both change. Positions and linear velocities are divided by the length of
# the chain: an arm and its copy at twice the size are equal.

expert_qpos = np.array([0.3, 0.5, -0.2, -1.2, 0.4, 0.9, 0.0])  # rad, one for each joint
expert_qvel = np.array([0.5, 0.0, 0.0, -0.5, 0.0, 0.0, 0.0])  # rad/s
states = mimic.link_states(expert, expert_qpos, expert_qvel)
print("\ndirections of the expert's links, in the base frame:")
for name, direction in zip(expert.link_names, np.asarray(states.direction), strict=True):
    print(f"  {name}  " + "  ".join(f"{x:+.2f}" for x in direction))

small, large, pose = mimic.planar_arm([0.2, 0.1]), mimic.planar_arm([2.0, 1.0]), np.array([0.4, 0.8])
apart = mimic.link_distances(
    mimic.link_states(small, pose), mimic.link_states(large, pose), mimic.DistanceWeights(translation=1.0, rotation=1.0)
)
print("\nan arm and its copy at ten times the size, in the same pose: link distances", np.diag(apart).round(6))

# ---- Which links belong together -------------------------------------------------------------------------------------
#
# A correspondence matrix W says how much each pair of links counts. The one that all environments use lays both chains
# on [0, 1] and takes the length that two links share there: for two Pandas, each link with itself, by its length. It
# does not depend on the pose, which leaves the distance with fewer local minima than the two that follow the distances:
# `hard_correspondence` (nearest neighbours) and `soft_correspondence` (a softmax).

correspondence = mimic.arc_length_correspondence(expert, learner)
print("\ncorrespondence by arc length (rows: expert, columns: learner)")
print(np.asarray(correspondence).round(2))

# ---- From link distances to one number -------------------------------------------------------------------------------
#
# The distance of two links is a weighted sum of four parts: translation (in chain lengths), rotation (an angle, 0 to
# pi), linear velocity and angular velocity. Let the learner do what is obvious: turn its four joints as the expert
# turns the joints of the same name. The embodiment distance is the mean of all entries of W times the link distances.

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

# Those are not on one scale: a rotation can be 3.1, a translation hardly more than 1. The weights decide what "alike"
# means. The paper's, used below, are rotation 1, angular velocity 0.01, linear velocity 0.001 and no translation. The
# default of the commands has a translation weight of 1 besides, by which arms resemble each other more.

paper = mimic.embodiment_distance(states, copied, correspondence, mimic.PAPER_WEIGHTS)
print(f"under the paper's weights: {paper:.4f}")

# ---- Which link is to blame? -----------------------------------------------------------------------------------------
#
# Before the mean there is a number for each pair of links. The sum over the expert's links says what each link of the
# learner adds. The sum of the shares is the distance again.

pairs = mimic.link_distances(states, copied, mimic.PAPER_WEIGHTS)
shares = np.asarray(correspondence * pairs).sum(axis=0) / pairs.size
print("\nwhat each link of the learner adds:")
for name, share in zip(learner.link_names, shares, strict=True):
    print(f"  {name:18}  {share:.4f}  ({share / paper:.0%})")
print(f"  sum                 {shares.sum():.4f}")

# ---- Is the distance small? ------------------------------------------------------------------------------------------
#
# A distance by itself says little. Two others give it a scale: that of a learner which stays in its zero pose, and the
# least that any pose and velocity of this learner can reach. `kinematic_bound` searches for the latter, at each time of
# a motion by itself; here the motion has one. It is found by descent from several starts, so in principle it may be
# above the true minimum.

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
