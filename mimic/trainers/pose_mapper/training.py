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

from mimic.compilation import compiling
from mimic.runs.checkpoints import delete_checkpoint, save_checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.pose_mapper.model import MapperModel, Params
from mimic.trainers.trainer import OnEvaluation

_WARM_UP = 0.02  # share of the updates over which the learning rate rises
_SHARED = 0.1  # share of the loss that all heads bear alike, so that none is left behind; the nearest bears the rest

Poses = Float[Array, "poses joints"]


def train(
    model: MapperModel,
    poses: Callable[[], tuple[Poses, Poses]],
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
      poses: those that every epoch goes through where they are not fresh, and the ones that tell when to stop; asked
        for once the programs are being compiled.
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
    steps, restored = restore or (0, None)
    done = steps // samples
    stretch = max(epochs // int(config.evaluations or 1), 1)
    optimiser = _optimiser(model, done)

    def begin(seed: int, restored: Params | None) -> Any:
        params = model.init(_keys(seed)[0]) if restored is None else restored
        return params, optimiser.init(params)

    start = jax.eval_shape(begin, seed, restored)
    shapes = poses_shape(model, samples), poses_shape(model, config.validation_poses)
    run_stretch = compiling(_stretch(model, optimiser, stretch), start, seed, 0, shapes[0])
    begins = compiling(begin, seed, restored)
    validate = compiling(lambda *given: _distances(model, *given).min(axis=1).mean(), start[0], shapes[1])
    params, optimiser_state = begins()(seed, restored)
    training, validation = poses()

    def save(steps: int, params: Params, metrics: dict[str, float]) -> bool:
        save_checkpoint(run_dir, steps, params)
        enough = on_evaluation(steps, params, metrics)
        signals.check()
        return enough

    save(steps, params, {})
    best = float(validate()(params, validation)), steps, params
    later: list[int] = []
    for _ in range(math.ceil((epochs - done) / stretch)):
        program = run_stretch()
        began = time.perf_counter()
        (params, optimiser_state), loss = program((params, optimiser_state), seed, done, training)
        loss = float(loss)
        done += stretch
        steps = done * samples
        speed = stretch * samples / (time.perf_counter() - began)
        value = float(validate()(params, validation))
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
    """AdamW; its rate rises, then falls along a cosine where the config says so. Biases do not decay."""
    config = model.config
    updates_per_epoch = int(config.samples or 0) // int(config.batch_size or 1)
    updates, rate = int(config.epochs or 0) * updates_per_epoch, float(config.learning_rate or 0.0)
    warm_up, final = max(round(_WARM_UP * updates), 1), rate * float(config.final_learning_rate or 0.0)
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, warm_up, max(updates, warm_up + 1), final)
    if config.final_learning_rate == 1:
        schedule = optax.constant_schedule(rate)
    offset = done_epochs * updates_per_epoch
    adam = optax.adamw(
        lambda count: schedule(count + offset), b2=0.99, weight_decay=config.weight_decay, mask=_is_matrix
    )
    return optax.chain(optax.clip_by_global_norm(1.0), adam)


def _is_matrix(params: Params) -> Any:
    return jax.tree.map(lambda x: x.ndim > 1, params)


def _stretch(
    model: MapperModel, optimiser: optax.GradientTransformation, epochs: int
) -> Callable[[Any, Any, Any, Poses], tuple[Any, Array]]:
    """Trains for some epochs: from (parameters, optimiser state), the seed, the epochs so far, and training poses.

    It gives the first as they are then, and the mean loss.
    """
    config = model.config
    samples, batch_size = int(config.samples or 0), int(config.batch_size or 1)

    def loss(params: Params, poses: Poses, dropout_key: Array | None) -> Array:
        distances = _distances(model, params, poses, dropout_key)
        nearest = distances.min(axis=1).mean()
        return (1 - _SHARED) * nearest + _SHARED * distances.mean()

    def update(carry: Any, batch: tuple[Poses, Array]) -> tuple[Any, Array]:
        params, state = carry
        poses, key = batch
        value, gradient = jax.value_and_grad(loss)(params, poses, key if config.dropout else None)
        change, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, change), state), value

    def run(carry: Any, seed: Any, done: Any, training: Poses) -> tuple[Any, Array]:
        _, key_epochs, key_dropout = _keys(seed)

        def epoch(carry: Any, number: Array) -> tuple[Any, Array]:
            own = jax.random.fold_in(key_epochs, number)
            poses = (
                random_poses(model, own, samples) if config.fresh else training[jax.random.permutation(own, samples)]
            )
            batches = poses.reshape(-1, batch_size, poses.shape[-1])
            keys = jax.random.split(jax.random.fold_in(key_dropout, number), len(batches))
            carry, losses = jax.lax.scan(update, carry, (batches, keys))
            return carry, losses.mean()

        carry, losses = jax.lax.scan(epoch, carry, done + jnp.arange(epochs))
        return carry, losses.mean()

    return run


def _keys(seed: Any) -> Array:
    """For the network, for the epochs, and for dropout."""
    return jax.random.split(jax.random.key(seed), 3)


def random_poses(model: MapperModel, key: Array, count: int) -> Poses:
    """Poses of the expert, uniform within its range."""
    lower, upper = jnp.asarray(model.expert.joint_range, jnp.float32).T
    return jax.random.uniform(key, (count, model.expert.num_joints), jnp.float32, minval=lower, maxval=upper)


def poses_shape(model: MapperModel, count: int) -> jax.ShapeDtypeStruct:
    """Of so many poses of the expert."""
    return jax.ShapeDtypeStruct((count, model.expert.num_joints), jnp.float32)


def _distances(
    model: MapperModel, params: Params, poses: Poses, dropout_key: Array | None = None
) -> Float[Array, "poses heads"]:
    """Of what each head proposes; every pose drops its own hidden units where there is a key."""

    def one(qpos: Array, key: Array | None) -> Array:
        candidates = model.candidates(params, qpos, dropout_key=key)
        return jax.vmap(lambda candidate: model.distance(qpos, candidate))(candidates)

    keys = None if dropout_key is None else jax.random.split(dropout_key, len(poses))
    return jax.vmap(one, (0, None if keys is None else 0))(poses, keys)
