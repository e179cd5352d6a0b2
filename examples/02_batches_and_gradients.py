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
# All functions of mimic are pure and take one sample: one pose, one velocity. `motion_distance` makes a function of two
# arms, which goes all the way from joint angles and velocities to the embodiment distance.

distance = mimic.motion_distance(expert, learner, correspondence, mimic.PAPER_WEIGHTS)


def composed(expert_qpos, expert_qvel, learner_qpos, learner_qvel):
    """The same, step by step: any weights, correspondence or reduction can go in here."""
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


# `jax.jit` compiles a function when it is first called. Without it each of the hundreds of small operations inside is a
# call of its own.

one = jax.jit(distance)
sample = [values[0] for values in motions(1)]
print(f"one sample: {one(*sample):.6f}; composed of its parts: {jax.jit(composed)(*sample):.6f}")

# ---- Gradients -------------------------------------------------------------------------------------------------------
#
# `jax.grad` differentiates by any argument. Here: how would the distance change if the learner moved a joint? Central
# differences must agree, as far as float32 can tell: the distance has seven digits, so that a difference over 0.02 rad
# has four or five.

gradient = jax.jit(jax.grad(distance, argnums=2))(*sample)
step = 0.01  # rad
differences = []
for joint in range(learner.num_joints):
    ahead, behind = ([*sample[:2], sample[2].at[joint].add(sign * step), sample[3]] for sign in (1, -1))
    differences.append((one(*ahead) - one(*behind)) / (2 * step))
print("gradient [1/rad]:     ", np.asarray(gradient).round(4))
print("central differences:  ", np.asarray(differences).round(4))

# At a match the distance has a kink, like an absolute value at 0: velocities count by the norm of their difference. The
# gradient is defined there all the same. It is 0, but for rounding, and not NaN.

twin = mimic.motion_distance(expert, expert, mimic.arc_length_correspondence(expert, expert), mimic.PAPER_WEIGHTS)
value, slopes = jax.jit(jax.value_and_grad(twin, argnums=(2, 3)))(sample[0], sample[1], sample[0], sample[1])
steepest = max(float(jnp.abs(slope).max()) for slope in slopes)
print(f"two equal arms in the same motion: distance {value:.1e}, gradient {steepest:.1e}")

# ---- Batches ---------------------------------------------------------------------------------------------------------
#
# `jax.vmap` makes a function of one sample a function of many. Nothing needs to be rewritten, and nothing is looped.

few = motions(5)
batched = jax.jit(jax.vmap(distance))(*few)
looped = [one(*(values[i] for values in few)) for i in range(5)]
print(f"five at once and one by one differ by {np.abs(np.asarray(batched) - np.asarray(looped)).max():.1e}")

# ---- Times -----------------------------------------------------------------------------------------------------------
#
# Two things to keep apart: the first call compiles, later ones run. And JAX returns before the result is there, so a
# clock must wait for it. Each time below is the median of five calls.


def timed(function, arguments):
    """Seconds of the first call, and of a later one."""
    times = []
    for _ in range(6):
        began = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - began)
    return times[0], statistics.median(times[1:])


count = 1_000_000 if jax.default_backend() == "gpu" else 20_000
batch = motions(count)
print(f"\n{count:,} pairs of motions")
print(f"{'':44}  first call   then        pairs/s")
for name, function in (
    ("distance, composed", composed),
    ("distance, motion_distance", distance),
    ("and gradient by the learner's angles, composed", jax.value_and_grad(composed, argnums=2)),
    ("and gradient, motion_distance", jax.value_and_grad(distance, argnums=2)),
):
    first, then = timed(jax.jit(jax.vmap(function)), batch)
    print(f"{name:46}  {first:6.2f} s  {1e3 * then:7.2f} ms  {count / then:12,.0f}")

# What `motion_distance` has over its parts is a gradient in closed form, and that it leaves out pairs of links which do
# not correspond. On NVIDIA GPUs its batches become one kernel besides. In return it needs a given matrix and constant
# weights to do so; for all other metrics it falls back to the composition, with the same result.

# ---- All three together ----------------------------------------------------------------------------------------------
#
# A thousand gradient descents at once, each to the pose that is most like one random pose of the expert. It is three
# lines, and it is not good: from one start each, many end in local minima. Example 3 has what is.

still = jnp.zeros((1000, 4))
poses = motions(1000)[0]


def at_rest(expert_qpos, qpos):
    return distance(expert_qpos, jnp.zeros(7), qpos, jnp.zeros(4))


pose_distance, slope = jax.vmap(at_rest), jax.vmap(jax.grad(at_rest, argnums=1))


@jax.jit
def descend(qpos):
    return jax.lax.fori_loop(0, 100, lambda _, qpos: qpos - 0.5 * slope(poses, qpos), qpos)


before, after = pose_distance(poses, still).mean(), pose_distance(poses, descend(still)).mean()
print(f"\na thousand descents of 100 steps: mean distance {before:.3f} before, {after:.3f} after")
