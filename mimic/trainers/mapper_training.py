"""Trains a pose mapper through the metric: no labels, and the distance itself is the loss (paper, eq. 23)."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from mimic.trainers.checkpoints import delete_checkpoint, save_checkpoint
from mimic.trainers.job import OnEvaluation
from mimic.trainers.pose_mapper import MapperModel, Params
from mimic.trainers.signals import Signals

_WARM_UP = 0.02  # share of the updates over which the learning rate rises
_SHARED = 0.1  # share of the loss that all heads bear alike, so that none is left behind; the nearest bears the rest

Poses = Float[Array, "poses joints"]


def train(
    model: MapperModel,
    training: Poses,
    validation: Poses,
    run_dir: Path,
    *,
    seed: int,
    on_evaluation: OnEvaluation,
    signals: Signals,
    restore: tuple[int, Params] | None = None,
) -> tuple[int, Params]:
    """Trains, and goes back to the best parameters where the distance on the validation poses has risen since.

    Args:
      model: with a resolved config.
      training: poses that every epoch goes through where they are not fresh.
      validation: poses that tell when to stop.
      run_dir: where checkpoints go; those after the best are deleted.
      seed: of the network, the order and the fresh poses.
      on_evaluation: called after each checkpoint; training ends where it returns True.
      signals: training ends after the next checkpoint if one came.
      restore: training poses so far, and parameters to go on from; the moments of the optimiser start anew.

    Returns:
      Training poses, and parameters after these.

    Raises:
      Interrupted: a signal came; a checkpoint is written.
    """
    config = model.config
    samples, epochs = int(config.samples or 0), int(config.epochs or 0)
    key_init, key_epochs = jax.random.split(jax.random.key(seed))
    steps, params = restore or (0, jax.jit(model.init)(key_init))
    done = steps // samples
    optimiser = _optimiser(model, done)
    optimiser_state = jax.jit(optimiser.init)(params)
    stretch = max(epochs // int(config.evaluations or 1), 1)
    validate = jax.jit(lambda params, poses: _distances(model, params, poses).min(axis=1).mean())
    run_stretch = _stretch_program(model, optimiser, training)

    def save(steps: int, params: Params, metrics: dict[str, float]) -> bool:
        save_checkpoint(run_dir, steps, params)
        enough = on_evaluation(steps, params, metrics)
        signals.check()
        return enough

    save(steps, params, {})
    best = float(validate(params, validation)), steps, params
    later: list[int] = []
    for _ in range(math.ceil((epochs - done) / stretch)):
        began = time.perf_counter()
        keys = jax.vmap(lambda epoch: jax.random.fold_in(key_epochs, epoch))(jnp.arange(done, done + stretch))
        (params, optimiser_state), loss = run_stretch((params, optimiser_state), keys)
        loss = float(loss.mean())
        done += stretch
        steps = done * samples
        speed = stretch * samples / (time.perf_counter() - began)
        value = float(validate(params, validation))
        enough = save(steps, params, {"loss": loss, "validation_distance": value, "sps": speed})
        if value < best[0]:
            best, later = (value, steps, params), []
        else:
            later.append(steps)
        if enough or (config.patience and len(later) >= config.patience):
            break
    for step in later:
        delete_checkpoint(run_dir, step)
    return best[1], best[2]


def _optimiser(model: MapperModel, done_epochs: int) -> optax.GradientTransformation:
    """Adam; its rate rises, then falls along a cosine where the config says so."""
    config = model.config
    updates_per_epoch = int(config.samples or 0) // int(config.batch_size or 1)
    updates, rate = int(config.epochs or 0) * updates_per_epoch, float(config.learning_rate or 0.0)
    warm_up, final = max(round(_WARM_UP * updates), 1), rate * float(config.final_learning_rate or 0.0)
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, warm_up, max(updates, warm_up + 1), final)
    if config.final_learning_rate == 1:
        schedule = optax.constant_schedule(rate)
    offset = done_epochs * updates_per_epoch
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(lambda count: schedule(count + offset), b2=0.99))


def _stretch_program(
    model: MapperModel, optimiser: optax.GradientTransformation, training: Poses
) -> Callable[[Any, Array], tuple[Any, Array]]:
    """A compiled function of (parameters, optimiser state) and the keys of epochs; also gives each epoch's loss."""
    config = model.config
    samples, batch_size = int(config.samples or 0), int(config.batch_size or 1)

    def loss(params: Params, poses: Poses) -> Array:
        distances = _distances(model, params, poses)
        nearest = distances.min(axis=1).mean()
        return (1 - _SHARED) * nearest + _SHARED * distances.mean()

    def update(carry: Any, poses: Poses) -> tuple[Any, Array]:
        params, state = carry
        value, gradient = jax.value_and_grad(loss)(params, poses)
        change, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, change), state), value

    def epoch(carry: Any, key: Array) -> tuple[Any, Array]:
        poses = random_poses(model, key, samples) if config.fresh else training[jax.random.permutation(key, samples)]
        carry, losses = jax.lax.scan(update, carry, poses.reshape(-1, batch_size, poses.shape[-1]))
        return carry, losses.mean()

    return jax.jit(lambda carry, keys: jax.lax.scan(epoch, carry, keys))


def random_poses(model: MapperModel, key: Array, count: int) -> Poses:
    """Poses of the expert, uniform within its range."""
    lower, upper = jnp.asarray(model.expert.joint_range, jnp.float32).T
    return jax.random.uniform(key, (count, model.expert.num_joints), minval=lower, maxval=upper)


def _distances(model: MapperModel, params: Params, poses: Poses) -> Float[Array, "poses heads"]:
    def one(qpos: Array) -> Array:
        return jax.vmap(lambda candidate: model.distance(qpos, candidate))(model.candidates(params, qpos))

    return jax.vmap(one)(poses)
