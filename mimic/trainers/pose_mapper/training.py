"""Training of a pose mapper: the embodiment distance is the loss, and there are no labels (paper, eq. 23)."""

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from mimic.base.compilation import Background, compiling
from mimic.runs.checkpoints import STATE_UNUSED, Checkpoint, checkpoint_steps, save_checkpoint, thin_checkpoints
from mimic.runs.divergence import check_finite
from mimic.runs.signals import Signals
from mimic.trainers.config import PoseMapperConfig
from mimic.trainers.pose_mapper.model import MapperModel, Params, random_poses
from mimic.trainers.schedules import schedules_from
from mimic.trainers.trainer import OnEvaluation

_WARM_UP = 0.02  # fraction of the updates over which the learning rate rises
# Fraction of the loss that is the mean over all heads, so that each head is trained; the rest is the nearest head's.
_ALL_HEADS = 0.1

Poses = Float[Array, "poses joints"]


class _Functions(NamedTuple):
    """The functions of a training, which compile in the background.

    Attributes:
      start: (seed, parameters to start from or None, updates done with them) -> (parameters, optimiser state).
      train: a training epoch, see `_training_epoch`.
      validate: (parameters, poses) -> mean distance of the nearest head.
    """

    start: Background[Callable[..., Any]]
    train: Background[Callable[..., Any]]
    validate: Background[Callable[..., Any]]


class _Best(NamedTuple):
    """The parameters with the smallest validation distance so far."""

    distance: float
    steps: int
    params: Params


# Above 40 lines because of its docstring.
def train(
    model: MapperModel,
    poses: Callable[[], tuple[Poses, Poses]],
    run_dir: Path,
    *,
    seed: int,
    on_evaluation: OnEvaluation,
    signals: Signals,
    restored: Checkpoint | None = None,
) -> tuple[int, Params]:
    """Trains a mapper. If the distance on the validation poses rises, the result has the best parameters before.

    Args:
      model: the mapper, with the settings of the training.
      poses: returns poses of the expert [rad], of training, for epochs without fresh ones, and of validation; called
        after the functions of the training have started to compile.
      run_dir: folder of the checkpoints.
      seed: random seed of the network, the order and the fresh poses.
      on_evaluation: called after each checkpoint.
      signals: signals of the process; after one, training ends at the next checkpoint.
      restored: the checkpoint to continue from. With the training's state the result is that of a training that was not
        interrupted; without it, the moments of the optimiser start anew.

    Returns:
      Training poses so far and parameters of the result.

    Raises:
      Interrupted: a signal was received; a checkpoint has been written.
      Diverged: a number is not finite.
      OSError: a checkpoint cannot be written.
    """
    steps, initial, leaves, metrics = restored or Checkpoint(0, None, None, {})
    config = model.config
    interval = max(config.epochs // config.evaluations, 1)  # epochs between two evaluations
    functions = _compile(model, interval, seed, initial)
    state = functions.start()(seed, initial, steps // config.batch_size)
    training, validation = poses()
    best = _Best(float(functions.validate()(state[0], validation)), steps, state[0])
    saved = _unflatten((state, tuple(best)), leaves)
    if saved is None and steps:
        print(STATE_UNUSED, file=sys.stderr)
    elif saved is not None:
        (params, optimiser_state), (distance, best_steps, best_params) = saved
        state = params, schedules_from(optimiser_state, steps // config.batch_size)
        best = _Best(float(distance), int(best_steps), best_params)
    while True:
        if steps not in checkpoint_steps(run_dir):
            saved = [np.asarray(leaf) for leaf in jax.tree.leaves(jax.device_get((state, tuple(best))))]
            save_checkpoint(run_dir, steps, state[0], saved, metrics)
            thin_checkpoints(run_dir, config.keep, best.steps)
        on_evaluation(steps, state[0], metrics)
        signals.check()
        evaluations_since_best = (steps - best.steps) // (interval * config.samples)
        impatient = config.patience and evaluations_since_best >= config.patience
        if impatient or steps >= config.total_steps:
            return best.steps, best.params
        run = functions.train()
        began = time.perf_counter()
        state, loss = run(state, seed, steps // config.samples, training)
        loss = float(loss)
        steps += interval * config.samples
        check_finite(steps, {"loss": loss}, jax.device_get(state[0]))
        speed = interval * config.samples / (time.perf_counter() - began)
        distance = float(functions.validate()(state[0], validation))
        metrics = {"loss": loss, "validation_distance": distance, "sps": speed}
        if distance < best.distance:
            best = _Best(distance, steps, state[0])


def _unflatten(template: Any, leaves: Sequence[np.ndarray] | None) -> Any:
    """A pytree with the template's structure; None without leaves, or where their shapes do not fit."""
    expected, structure = jax.tree.flatten(template)
    if leaves is None or [np.shape(leaf) for leaf in leaves] != [np.shape(leaf) for leaf in expected]:
        return None
    return jax.tree.unflatten(structure, leaves)


def _compile(model: MapperModel, interval: int, seed: int, initial: Params | None) -> _Functions:
    optimiser = _optimiser(model.config)

    def start(seed: int, initial: Params | None, done_updates: int) -> Any:
        params = model.init(_keys(seed)[0]) if initial is None else initial
        return params, schedules_from(optimiser.init(params), done_updates)

    def validation_distance(params: Params, poses: Poses) -> Array:
        return _proposed_distances(model, params, poses).min(axis=1).mean()

    state = jax.eval_shape(start, seed, initial, 0)
    training, validation = (
        jax.ShapeDtypeStruct((count, model.expert.num_joints), jnp.float32)
        for count in (model.config.samples, model.config.validation_poses)
    )
    run = _training_epoch(model, optimiser, interval)
    train = compiling(run, state, seed, 0, training)  # first: it takes longest
    return _Functions(
        start=compiling(start, seed, initial, 0),
        train=train,
        validate=compiling(validation_distance, state[0], validation),
    )


def _optimiser(config: PoseMapperConfig) -> optax.GradientTransformation:
    """Adam with a constant rate, or with a warm-up and a cosine decay."""
    updates_per_epoch = config.samples // config.batch_size
    updates, rate = config.epochs * updates_per_epoch, config.learning_rate
    warm_up, final = max(round(_WARM_UP * updates), 1), rate * config.final_learning_rate
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, warm_up, max(updates, warm_up + 1), final)
    if config.final_learning_rate == 1:
        schedule = optax.constant_schedule(rate)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule, b2=0.99))


def _training_epoch(
    model: MapperModel, optimiser: optax.GradientTransformation, epochs: int
) -> Callable[[Any, Any, Any, Poses], tuple[Any, Array]]:
    """A function that trains for some epochs.

    It maps the state (parameters, optimiser state), the seed, the number of epochs so far and the training poses to the
    new state and the mean loss.
    """
    count, batch_size = model.config.samples, model.config.batch_size

    def loss(params: Params, poses: Poses) -> Array:
        distances = _proposed_distances(model, params, poses)
        nearest = distances.min(axis=1).mean()
        return (1 - _ALL_HEADS) * nearest + _ALL_HEADS * distances.mean()

    def update(carry: Any, poses: Poses) -> tuple[Any, Array]:
        params, state = carry
        value, gradient = jax.value_and_grad(loss)(params, poses)
        change, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, change), state), value

    def run(carry: Any, seed: Any, done: Any, training: Poses) -> tuple[Any, Array]:
        key_epochs = _keys(seed)[1]

        def epoch(carry: Any, number: Array) -> tuple[Any, Array]:
            key = jax.random.fold_in(key_epochs, number)
            if model.config.fresh:
                poses = random_poses(model.expert, key, count)
            else:
                poses = training[jax.random.permutation(key, count)]
            carry, losses = jax.lax.scan(update, carry, poses.reshape(-1, batch_size, poses.shape[1]))
            return carry, losses.mean()

        carry, losses = jax.lax.scan(epoch, carry, done + jnp.arange(epochs))
        return carry, losses.mean()

    return run


def _proposed_distances(model: MapperModel, params: Params, poses: Poses) -> Float[Array, "poses heads"]:
    """Distances of the poses that the heads propose."""
    return jax.vmap(lambda qpos: model.distances(qpos, model.candidates(params, qpos)))(poses)


def _keys(seed: Any) -> Array:
    """Random keys of the network and of the epochs; a third one is unused, so that the numbers stay those of before."""
    return jax.random.split(jax.random.key(seed), 3)
