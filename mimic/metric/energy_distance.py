"""Energy distance between two ensembles of arm states, for experts and learners that are stochastic."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.metric.config import MetricConfig
from mimic.metric.distance import Metric
from mimic.metric.kinematics import LinkStates


def energy_distance(
    expert: Embodiment,
    learner: Embodiment,
    expert_states: LinkStates,
    learner_states: LinkStates,
    metric: MetricConfig | None = None,
) -> Float[Array, ""]:
    """Energy distance between the distributions of an expert's and a learner's states (Székely and Rizzo, 2013).

    2 E d(X, Y) - E d(X, X') - E d(Y, Y'), where d is the embodiment distance and the last two are within one arm. It is
    0 between equal ensembles of one arm; of different arms even the nearest ensembles may leave more than 0, or less.
    In contrast to the mean embodiment distance it does not ask which state of the learner belongs to which of the
    expert's.

    Args:
      expert: the expert.
      learner: the learner.
      expert_states: link states of an ensemble, [samples, links, 3] each.
      learner_states: likewise; the numbers of samples may differ.
      metric: config of d; the default metric where None.
    """
    config = metric or MetricConfig()
    arms = (config.compared(expert), expert_states), (config.compared(learner), learner_states)
    (first, x), (second, y) = arms
    between = _mean_distance(config.build(first, second), x, y)
    return 2 * between - sum(_mean_distance(config.build(arm, arm), states, states) for arm, states in arms)


def _mean_distance(metric: Metric, a: LinkStates, b: LinkStates) -> Float[Array, ""]:
    """Mean distance over all pairs of samples."""

    def of_sample(state: LinkStates) -> Array:
        return metric(jax.tree.map(lambda x: x[None], state), b).mean()

    return jnp.mean(jax.lax.map(of_sample, a))  # a row at a time: all pairs at once take 4 KB each
