"""2. One pose, a million poses, and their gradients: jit, vmap, grad.

    python examples/02_batches_and_gradients.py

Prints times on the machine that it runs on; writes nothing.
"""

import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

import mimic  # before JAX computes anything: on CPUs some versions of JAX need a flag, which mimic sets

expert, learner = mimic.panda(), mimic.panda(locked=(3, 6, 7))
correspondence = mimic.arc_length_correspondence(expert, learner)
print(f"computing on: {jax.devices()[0].device_kind}, {jax.default_backend()}")

# ---- One sample ------------------------------------------------------------------------------------------------------
#
# All functions of mimic are pure and take one sample: one pose, one velocity. `motion_distance` returns, for two arms,
# the function from their joint angles and velocities to the embodiment distance.

distance = mimic.motion_distance(expert, learner, correspondence, mimic.PAPER_WEIGHTS)


def composed(expert_qpos, expert_qvel, learner_qpos, learner_qvel):
    """The same, composed: any weights or correspondence can be used here."""
    return mimic.embodiment_distance(
        mimic.link_states(expert, expert_qpos, expert_qvel),
        mimic.link_states(learner, learner_qpos, learner_qvel),
        correspondence,
        mimic.PAPER_WEIGHTS,
    )


rng = np.random.default_rng(0)


def motions(count):
    """Random angles and velocities of expert and learner."""
    return [jnp.asarray(rng.uniform(-np.pi, np.pi, (count, joints)), jnp.float32) for joints in (7, 7, 4, 4)]


# `jax.jit` compiles a function at its first call. Without it, each of its hundreds of operations runs separately.

one = jax.jit(distance)
sample = [values[0] for values in motions(1)]
print(f"one sample: {one(*sample):.6f}; composed: {jax.jit(composed)(*sample):.6f}")

# ---- Gradients -------------------------------------------------------------------------------------------------------
#
# `jax.grad` differentiates with respect to any argument, here the learner's joint angles. Central differences agree
# within the precision of float32: the distance has seven digits, so a difference over 0.02 rad has four or five.

gradient = jax.jit(jax.grad(distance, argnums=2))(*sample)
step = 0.01  # rad
differences = []
for joint in range(learner.num_joints):
    upper, lower = ([*sample[:2], sample[2].at[joint].add(sign * step), sample[3]] for sign in (1, -1))
    differences.append((one(*upper) - one(*lower)) / (2 * step))
print("gradient [1/rad]:     ", np.asarray(gradient).round(4))
print("central differences:  ", np.asarray(differences).round(4))

# At a match the distance has a kink, as the absolute value has at 0: its velocity parts are norms of differences. The
# gradient is defined there too: it is 0 up to rounding, and never NaN.

twin = mimic.motion_distance(expert, expert, mimic.arc_length_correspondence(expert, expert), mimic.PAPER_WEIGHTS)
value, gradients = jax.jit(jax.value_and_grad(twin, argnums=(2, 3)))(sample[0], sample[1], sample[0], sample[1])
largest = max(float(jnp.abs(entry).max()) for entry in gradients)
print(f"two equal arms in the same motion: distance {value:.1e}, gradient {largest:.1e}")

# ---- Batches ---------------------------------------------------------------------------------------------------------
#
# `jax.vmap` turns a function of one sample into a function of a batch, without a loop.

few = motions(5)
batched = jax.jit(jax.vmap(distance))(*few)
looped = [one(*(values[i] for values in few)) for i in range(5)]
print(f"a batch of five and a loop over them differ by {np.abs(np.asarray(batched) - np.asarray(looped)).max():.1e}")

# ---- Times -----------------------------------------------------------------------------------------------------------
#
# The first call compiles, later calls only run. JAX returns before the result is computed, so a timer must wait for it
# (`jax.block_until_ready`). Each time below is the median of five calls.


def timed(function, arguments):
    """Seconds of the first call, and the median of later ones."""
    times = []
    for _ in range(6):
        began = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - began)
    return times[0], statistics.median(times[1:])


count = 1_000_000 if jax.default_backend() == "gpu" else 20_000
batch = motions(count)
print(f"\n{count:,} pairs of motions")
print(f"{'':44}  first call   later       pairs/s")
for name, function in (
    ("distance, composed", composed),
    ("distance, motion_distance", distance),
    ("and gradient for the learner's angles, composed", jax.value_and_grad(composed, argnums=2)),
    ("and gradient, motion_distance", jax.value_and_grad(distance, argnums=2)),
):
    first, later = timed(jax.jit(jax.vmap(function)), batch)
    print(f"{name:47}  {first:6.2f} s  {1e3 * later:7.2f} ms  {count / later:12,.0f}")

# `motion_distance` is faster than the composed function because its gradient is in closed form and it skips pairs of
# links that do not correspond. On NVIDIA GPUs a batch is one fused kernel. This needs a constant correspondence matrix
# and constant weights; for all other metrics it falls back to the composed function, with the same result.

# ---- All three together ----------------------------------------------------------------------------------------------
#
# A thousand gradient descents in parallel, each to the learner's pose of minimum distance to one random pose of the
# expert. Many end in local minima, because each has one initial guess only. Example 3 shows a better optimiser.

zero_poses = jnp.zeros((1000, 4))
poses = motions(1000)[0]


def at_rest(expert_qpos, qpos):
    return distance(expert_qpos, jnp.zeros(7), qpos, jnp.zeros(4))


pose_distance, pose_gradient = jax.vmap(at_rest), jax.vmap(jax.grad(at_rest, argnums=1))


@jax.jit
def descend(qpos):
    return jax.lax.fori_loop(0, 100, lambda _, qpos: qpos - 0.5 * pose_gradient(poses, qpos), qpos)


before, after = (pose_distance(poses, qpos).mean() for qpos in (zero_poses, descend(zero_poses)))
print(f"\na thousand descents of 100 steps: mean distance {before:.3f} before, {after:.3f} after")
