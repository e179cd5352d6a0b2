"""9. A swarm imitates an arm: 16 bodies without joints, whose links are the segments between neighbours.

    python examples/09_swarm.py [FOLDER]

The metric compares link states and needs neither joints nor a model: anything with a start and an end can be a link.
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
import optax
from scipy.optimize import linear_sum_assignment

import mimic

out = Path(sys.argv[1] if len(sys.argv) > 1 else time.strftime("examples_out/09_swarm-%Y%m%d-%H%M%S"))
out.mkdir(parents=True, exist_ok=True)

# ---- The expert ------------------------------------------------------------------------------------------------------
#
# A Panda moves for 10 s. Where are its links? `link_states` says: each link has a middle and a direction. With its
# length these are its ends, the corners of the arm's centre line.

arm = mimic.panda()
BODIES, STEP, DURATION = 16, 0.05, 10.0  # bodies, s, s
times = np.arange(0, DURATION, STEP)
amplitude, phase = np.array([1.2, 0.7, 0.5, 0.8, 0.4, 0.6, 0.0]), np.arange(7)
angles = np.array([0, 0.3, 0, -1.2, 0, 1.0, 0]) + amplitude * np.sin(0.5 * times[:, None] + phase)


def corners(qpos):
    """Ends of the links from base to tip [links + 1, 3], in chain lengths."""
    states, lengths = mimic.link_states(arm, qpos), arm.link_lengths / arm.chain_length
    half = 0.5 * lengths[:, None] * states.direction
    return jnp.concatenate([(states.position - half)[:1], states.position + half])


def points_along(line, count):
    """Points on a polygonal line at equal arc lengths, [count, 3]."""
    reached = jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.linalg.norm(jnp.diff(line, axis=0), axis=1))])
    at = jnp.linspace(0, reached[-1], count)
    return jnp.stack([jnp.interp(at, reached, line[:, axis]) for axis in range(3)], axis=1)


expert_points = np.asarray(jax.vmap(lambda qpos: points_along(corners(qpos), BODIES))(jnp.asarray(angles, jnp.float32)))

# ---- Links without joints --------------------------------------------------------------------------------------------
#
# The links of the swarm are the segments from each body to the next: 15 links of 16 bodies. The arm's links are divided
# at equal arc lengths as well, so that link n corresponds to link n and the correspondence is the identity. With the
# arm's own seven links `arc_length_correspondence` would do, but all bodies at one link would want to be in its middle.


def segment_states(points):
    """Link states of the segments between points [n, 3]."""
    segments = jnp.diff(points, axis=0)
    direction = segments / jnp.sqrt(jnp.sum(segments**2, axis=1, keepdims=True) + 1e-12)  # smooth where points coincide
    still = jnp.zeros_like(segments)
    return mimic.LinkStates(0.5 * (points[1:] + points[:-1]), direction, still, still)


weights = mimic.DistanceWeights(translation=1.0, rotation=1.0)


@jax.jit
def distance(swarm, expert):
    return mimic.embodiment_distance(segment_states(expert), segment_states(swarm), jnp.eye(BODIES - 1), weights)


# ---- Who is whose neighbour ------------------------------------------------------------------------------------------
#
# The bodies hover anywhere, in no order. Nothing holds them together, so their topology is free: any order of the
# bodies is a chain. Bodies are assigned to places along the arm so that the sum of the flights is shortest.

start = np.random.default_rng(0).uniform([-0.6, -0.6, 0.0], [0.6, 0.6, 1.0], (BODIES, 3)).astype(np.float32)
flights = np.linalg.norm(start[:, None] - expert_points[0][None], axis=2)
order = linear_sum_assignment(flights)[0][np.argsort(linear_sum_assignment(flights)[1])]
assigned = start[order]
print(f"distance of the swarm in the order of its numbers: {distance(start, expert_points[0]):.3f}")
print(f"with the neighbours of the shortest flights:       {distance(assigned, expert_points[0]):.3f}")

# ---- Flight ----------------------------------------------------------------------------------------------------------
#
# In each step, every body follows the gradient of the embodiment distance by its own position: 20 steps of optax's
# Adam, ever smaller, from where the swarm is. No body flies faster than half a chain length per second.

FASTEST, STEPS = 0.5, 20  # chain lengths per second; of the optimiser
optimiser = optax.adam(optax.cosine_decay_schedule(0.02, STEPS))


@jax.jit
def next_swarm(swarm, expert):
    def descend(carry, _):
        points, state = carry
        updates, state = optimiser.update(jax.grad(distance)(points, expert), state)
        return (optax.apply_updates(points, updates), state), None

    (goal, _), _ = jax.lax.scan(descend, (swarm, optimiser.init(swarm)), length=STEPS)
    step = goal - swarm
    length = jnp.linalg.norm(step, axis=1, keepdims=True)
    return swarm + step * jnp.minimum(1, FASTEST * STEP / jnp.maximum(length, 1e-9))


swarm, flown = assigned, []
for points in expert_points:
    flown.append(swarm)
    swarm = np.asarray(next_swarm(swarm, points))
flown = np.array(flown)
distances = np.array([distance(swarm, points) for swarm, points in zip(flown, expert_points, strict=True)])
nearest = np.linalg.norm(flown - expert_points, axis=2).mean(axis=1)  # what nothing minimises: bodies from the arm
formed = int(np.argmax(distances < 0.1 * distances[0]))
speed = np.linalg.norm(np.diff(flown, axis=0), axis=2).max(axis=1) / STEP
print(f"\ndistance at the start: {distances[0]:.3f}; a tenth of it after {times[formed]:.1f} s; "
      f"mean of the last 5 s: {distances[len(times) // 2 :].mean():.3f}")  # fmt: skip
print(f"bodies from their places on the arm [chain lengths]: {nearest[0]:.3f} at the start, "
      f"{nearest[len(times) // 2 :].mean():.3f} in the last 5 s")  # fmt: skip
print(
    f"fastest body [chain lengths per second]: {speed.max():.2f}, in the last 5 s {speed[len(times) // 2 :].max():.2f}"
)

# ---- A picture -------------------------------------------------------------------------------------------------------

shown = [0, formed // 2, formed, len(times) // 2, len(times) - 1]
figure = plt.figure(figsize=(3.2 * len(shown), 3.6))
colours = plt.colormaps["viridis"](np.linspace(0, 0.95, BODIES))
for panel, index in enumerate(shown):
    axes = figure.add_subplot(1, len(shown), panel + 1, projection="3d")
    axes.plot(*expert_points[index].T, color="0.75", linewidth=9, solid_capstyle="round", zorder=1)
    axes.plot(*flown[index].T, color="0.35", linewidth=1, zorder=2)
    axes.scatter(*flown[index].T, c=colours, s=34, depthshade=False, edgecolors="k", linewidths=0.4, zorder=3)
    axes.set(xlim=(-0.6, 0.6), ylim=(-0.6, 0.6), zlim=(0, 1), title=f"{times[index]:.1f} s: {distances[index]:.3f}")
    axes.set_box_aspect((1.2, 1.2, 1))
    axes.set_xticklabels([])
    axes.set_yticklabels([])
    axes.set_zticklabels([])
figure.suptitle("An arm (grey) and 16 bodies with the segments between neighbours: time and embodiment distance")
figure.tight_layout()
figure.savefig(out / "swarm.png", dpi=110)
print(f"results: {out}")
