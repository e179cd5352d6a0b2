"""What a policy observes of its expert in a world that measures it: noisy link states, of which some are missing."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mimic.metric.kinematics import LinkStates
from mimic.physics.world import WorldConfig


class SeenExpert(NamedTuple):
    """Measured link states of an expert at several ticks.

    Attributes:
      states: [ticks, links, 3] each; 0 where a link is not visible, and None for what is not measured at all. Of a hand
        only the axes are measured.
      visible: [ticks, links] whether each link is visible. A hand is visible with the last link.
    """

    states: LinkStates
    visible: Bool[Array, "ticks links"]

    def vector(self) -> Float[Array, " numbers"]:
        """All numbers tick by tick: link states in their order, two axes of a hand, and which links are visible."""
        states, ticks = self.states, len(self.visible)
        parts = [states.position, states.direction, states.linear_velocity, states.angular_velocity]
        if states.hand is not None:
            parts.append(states.hand.axes.reshape(ticks, -1, 3, 3)[:, :, ::2])
        parts.append(self.visible.astype(jnp.float32))
        return jnp.concatenate([x.reshape(ticks, -1) for x in parts if x is not None], axis=1).ravel()


def see(world: WorldConfig, states: LinkStates, key: Array, step: Array, dt: float) -> SeenExpert:
    """Measures an expert in consecutive ticks, with the noise and the gaps of an episode.

    Positions and directions have independent noise at each tick. Velocities are those of differences of two
    measurements, so that their noise is that of the positions over `dt`, and negatively correlated in time. What is
    measured at a tick is the same whenever it is observed; a velocity is 0 where the tick before was lost.

    Args:
      world: `expert` says what is measured; `expert_noise`, `expert_loss` and `hidden_links` how well.
      states: the true states, [ticks, links, 3] each.
      key: of the episode.
      step: of the first tick.
      dt: duration of a tick [s].
    """
    key_level, key_count, key_links, key_loss, key_noise = jax.random.split(key, 5)
    ticks, links, _ = states.position.shape
    minimum, maximum = world.expert_noise
    level = jax.random.uniform(key_level, minval=minimum, maxval=maximum)
    count = jax.random.randint(key_count, (), world.hidden_links[0], world.hidden_links[1] + 1)
    hidden = jnp.argsort(jnp.argsort(jax.random.uniform(key_links, (links,)))) < count
    rows = 2 * links + (0 if states.hand is None else states.hand.axes.shape[1])

    def drawn(tick: Array) -> tuple[Array, Array]:
        noise = level * jax.random.normal(jax.random.fold_in(key_noise, tick), (rows, 3))
        return noise, jax.random.uniform(jax.random.fold_in(key_loss, tick)) < world.expert_loss

    noise, lost = jax.vmap(drawn)(step + jnp.arange(ticks + 1))  # the first is that of the tick before
    of_positions, of_directions, of_axes = jnp.split(noise, [links, 2 * links], axis=1)
    visible = ~(hidden | lost[1:, None])
    moving = visible & ~lost[:-1, None]

    def measured(true: Array, noise: Array, is_visible: Array = visible) -> Array:
        return jnp.where(is_visible[..., None], true + noise, 0.0)

    position = measured(states.position, of_positions[1:])
    linear_velocity = measured(states.linear_velocity, jnp.diff(of_positions, axis=0) / dt, moving)
    if world.expert == "points":
        return SeenExpert(LinkStates(position, None, linear_velocity, None), visible)
    assert states.direction is not None and states.angular_velocity is not None
    direction = measured(states.direction, of_directions[1:])
    angular_velocity = measured(states.angular_velocity, jnp.diff(of_directions, axis=0) / dt, moving)
    hand = states.hand
    if hand is not None:
        unknown = jnp.full_like(hand.position, jnp.nan)
        axes = measured(hand.axes, of_axes[1:], visible[:, -1:])
        hand = dataclasses.replace(hand, axes=axes, position=unknown, angular_velocity=unknown)
    return SeenExpert(LinkStates(position, direction, linear_velocity, angular_velocity, hand), visible)
