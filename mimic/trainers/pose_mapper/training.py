"""Training of a pose mapper: the embodiment distance is the loss, and there are no labels (paper, eq. 23)."""

import dataclasses
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

from mimic.arms.sampler import Sampler
from mimic.base.compilation import Background, compiling
from mimic.runs.checkpoints import STATE_UNUSED, Checkpoint, checkpoint_steps, save_checkpoint, thin_checkpoints
from mimic.runs.divergence import check_finite
from mimic.runs.signals import Signals
from mimic.trainers.config import PoseMapperConfig
from mimic.trainers.pose_mapper.model import MapperModel, Params
from mimic.trainers.pose_mapper.pair import Target, random_poses
from mimic.trainers.schedules import schedules_from
from mimic.trainers.trainer import OnEvaluation

_WARM_UP = 0.02  # fraction of the updates over which the learning rate rises
# Fraction of the loss that is the mean over all heads, so that each head is trained; the rest is the nearest head's.
_ALL_HEADS = 0.1

Samples = Any  # a pytree of arrays [samples, ...]: what a loss is computed of


@dataclasses.dataclass(frozen=True, eq=False)
class Objective:
    """What a training minimises, as pure functions.

    Attributes:
      init: random key -> parameters.
      draw: (random key, count) -> samples.
      distances: (parameters, samples) -> distances [samples, heads].
    """

    init: Callable[[Array], Params]
    draw: Callable[[Array, int], Samples]
    distances: Callable[[Params, Samples], Float[Array, "samples heads"]]

    def samples_shape(self, count: int) -> Any:
        """Shapes of `count` samples."""
        return jax.eval_shape(lambda: self.draw(jax.random.key(0), count))


class _Functions(NamedTuple):
    """The functions of a training, which compile in the background.

    Attributes:
      start: (seed, parameters to start from or None, updates done with them) -> (parameters, optimiser state).
      train: a training epoch, see `_training_epoch`.
      validate: (parameters, samples) -> mean distance of the nearest head.
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
    objective: Objective,
    config: PoseMapperConfig,
    samples: Callable[[], tuple[Samples, Samples]],
    run_dir: Path,
    *,
    seed: int,
    on_evaluation: OnEvaluation,
    signals: Signals,
    restored: Checkpoint | None = None,
) -> tuple[int, Params]:
    """Trains a mapper. If the distance on the validation samples rises, the result has the best parameters before.

    Args:
      objective: what is minimised.
      config: settings of the training.
      samples: returns those of training, for epochs without fresh ones, and those of validation; called after the
        functions of the training have started to compile.
      run_dir: folder of the checkpoints.
      seed: random seed of the network, the order and the fresh samples.
      on_evaluation: called after each checkpoint; training ends when it returns True.
      signals: signals of the process; after one, training ends at the next checkpoint.
      restored: the checkpoint to continue from. With the training's state the result is that of a training that was not
        interrupted; without it, the moments of the optimiser start anew.

    Returns:
      Training samples so far and parameters of the result.

    Raises:
      Interrupted: a signal was received; a checkpoint has been written.
      Diverged: a number is not finite.
      OSError: a checkpoint cannot be written.
    """
    steps, initial, leaves, metrics = restored or Checkpoint(0, None, None, {})
    interval = max(config.epochs // config.evaluations, 1)  # epochs between two evaluations
    functions = _compile(objective, config, interval, seed, initial)
    state = functions.start()(seed, initial, steps // config.batch_size)
    training, validation = samples()
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
        stop = on_evaluation(steps, state[0], metrics)
        signals.check()
        evaluations_since_best = (steps - best.steps) // (interval * config.samples)
        impatient = config.patience and evaluations_since_best >= config.patience
        if stop or impatient or steps >= config.total_steps:
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


def _compile(
    objective: Objective, config: PoseMapperConfig, interval: int, seed: int, initial: Params | None
) -> _Functions:
    optimiser = _optimiser(config)

    def start(seed: int, initial: Params | None, done_updates: int) -> Any:
        params = objective.init(_keys(seed)[0]) if initial is None else initial
        return params, schedules_from(optimiser.init(params), done_updates)

    def validation_distance(params: Params, samples: Samples) -> Array:
        return objective.distances(params, samples).min(axis=1).mean()

    state = jax.eval_shape(start, seed, initial, 0)
    training, validation = map(objective.samples_shape, (config.samples, config.validation_poses))
    run = _training_epoch(objective, config, optimiser, interval)
    train = compiling(run, state, seed, 0, training)  # first: it takes longest
    return _Functions(
        start=compiling(start, seed, initial, 0),
        train=train,
        validate=compiling(validation_distance, state[0], validation),
    )


def _optimiser(config: PoseMapperConfig) -> optax.GradientTransformation:
    """AdamW with a constant rate, or with a warm-up and a cosine decay. Biases do not decay."""
    updates_per_epoch = config.samples // config.batch_size
    updates, rate = config.epochs * updates_per_epoch, config.learning_rate
    warm_up, final = max(round(_WARM_UP * updates), 1), rate * config.final_learning_rate
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, warm_up, max(updates, warm_up + 1), final)
    if config.final_learning_rate == 1:
        schedule = optax.constant_schedule(rate)
    adam = optax.adamw(schedule, b2=0.99, weight_decay=config.weight_decay, mask=_is_kernel)
    return optax.chain(optax.clip_by_global_norm(1.0), adam)


def _is_kernel(params: Params) -> Any:
    """By name: the biases of attention have two axes."""
    return jax.tree_util.tree_map_with_path(lambda path, _: path[-1].key == "kernel", params)


def _training_epoch(
    objective: Objective, config: PoseMapperConfig, optimiser: optax.GradientTransformation, epochs: int
) -> Callable[[Any, Any, Any, Samples], tuple[Any, Array]]:
    """A function that trains for some epochs.

    It maps the state (parameters, optimiser state), the seed, the number of epochs so far and the training samples to
    the new state and the mean loss.
    """
    count, batch_size = config.samples, config.batch_size

    def loss(params: Params, samples: Samples) -> Array:
        distances = objective.distances(params, samples)
        nearest = distances.min(axis=1).mean()
        return (1 - _ALL_HEADS) * nearest + _ALL_HEADS * distances.mean()

    def update(carry: Any, samples: Samples) -> tuple[Any, Array]:
        params, state = carry
        value, gradient = jax.value_and_grad(loss)(params, samples)
        change, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, change), state), value

    def run(carry: Any, seed: Any, done: Any, training: Samples) -> tuple[Any, Array]:
        key_epochs = _keys(seed)[1]

        def epoch(carry: Any, number: Array) -> tuple[Any, Array]:
            key = jax.random.fold_in(key_epochs, number)
            samples = objective.draw(key, count) if config.fresh else _shuffled(key, training, count)
            batches = jax.tree.map(lambda x: x.reshape(-1, batch_size, *x.shape[1:]), samples)
            carry, losses = jax.lax.scan(update, carry, batches)
            return carry, losses.mean()

        carry, losses = jax.lax.scan(epoch, carry, done + jnp.arange(epochs))
        return carry, losses.mean()

    return run


def _shuffled(key: Array, samples: Samples, count: int) -> Samples:
    order = jax.random.permutation(key, count)
    return jax.tree.map(lambda x: x[order], samples)


def _keys(seed: Any) -> Array:
    """Random keys of the network and of the epochs; a third one is unused, so that the numbers stay those of before."""
    return jax.random.split(jax.random.key(seed), 3)


def mapper_objective(model: MapperModel, sampler: Sampler | None = None) -> Objective:
    """The mean distance of the poses that a mapper proposes, before the Newton steps.

    A sample is a pose of the expert. Where a sampler draws the learners, and the experts that the mapper takes, it is a
    random key: arms and pose are drawn within the loss, so that an epoch needs no memory for its arms.
    """

    def target_of_key(key: Array) -> Target:
        assert sampler is not None
        key_learner, key_pose, key_expert = jax.random.split(key, 3)
        pair = model.pair(sampler(key_learner), sampler(key_expert) if model.takes_any_expert else None)
        return pair.target(random_poses(pair.expert, key_pose))

    def distances(params: Params, samples: Samples) -> Float[Array, "samples heads"]:
        def of_sample(sample: Array) -> Float[Array, " heads"]:
            target = model.pair().target(sample) if sampler is None else target_of_key(sample)
            return target.distances(model.candidates(params, target))

        return jax.vmap(of_sample)(samples)

    def poses(key: Array, count: int) -> Samples:
        return random_poses(model.expert.data, key, (count,))

    return Objective(model.init, poses if sampler is None else jax.random.split, distances)
