"""What differs between episodes: loads, friction, sensors and delays, drawn from the ranges of a `WorldConfig`."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from mimic.physics.world import WorldConfig

_INTERVALS = ("gravity_error", "payload", "payload_lever", "link_mass", "friction", "motor_gain")
_DELAYS = ("observation_delay", "action_delay")


@dataclasses.dataclass(frozen=True)
class World:
    """The numbers of some episodes, see `WorldConfig`; the arrays begin with [episodes].

    Attributes:
      gravity, stops, contacts: whether there are any.
      gravity_error, payload, payload_lever: [episodes].
      link_mass, friction, motor_gain, position_bias, start_offset: [episodes, joints].
      position_noise, velocity_noise, packet_loss: numbers.
      observation_delay, action_delay: [episodes].
    """

    gravity: bool
    stops: bool
    contacts: bool
    gravity_error: np.ndarray
    payload: np.ndarray
    payload_lever: np.ndarray
    link_mass: np.ndarray
    friction: np.ndarray
    motor_gain: np.ndarray
    position_bias: np.ndarray
    start_offset: np.ndarray
    position_noise: float
    velocity_noise: float
    packet_loss: float
    observation_delay: np.ndarray
    action_delay: np.ndarray

    def select(self, episodes: slice) -> "World":
        """The numbers of some of the episodes."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        selected = {key: x[episodes] for key, x in fields.items() if isinstance(x, np.ndarray)}
        return dataclasses.replace(self, **selected)


def draw_world(config: WorldConfig, episodes: int, joints: int, rng: np.random.Generator, edge: str = "") -> World:
    """Draws the numbers of some episodes.

    Args:
      config: the ranges.
      episodes, joints: numbers of them.
      rng: random numbers.
      edge: "" draws uniformly; "minimum", "maximum" or "corners" put every number at an end of its range, for "corners"
        at a random one.
    """
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("link_mass", "friction", "motor_gain"), (episodes, joints))
    fraction = {"": lambda shape: rng.uniform(size=shape), "minimum": np.zeros, "maximum": np.ones,
                "corners": lambda shape: rng.integers(0, 2, shape).astype(float)}[edge]  # fmt: skip

    def between(bounds: Sequence[float], shape: tuple[int, ...]) -> np.ndarray:
        return bounds[0] + (bounds[1] - bounds[0]) * fraction(shape)

    def delay(bounds: list[int]) -> np.ndarray:
        if edge:
            return np.round(between(bounds, (episodes,))).astype(int)
        return rng.integers(bounds[0], bounds[1] + 1, episodes)

    bias, start = ([-maximum, maximum] for maximum in (config.position_bias, config.start_noise))
    return World(
        gravity=config.gravity,
        stops=config.stops,
        contacts=config.contacts,
        **{name: between(getattr(config, name), shapes.get(name, (episodes,))) for name in _INTERVALS},
        position_bias=between(bias, (episodes, joints)),
        start_offset=between(start, (episodes, joints)),
        position_noise=config.position_noise,
        velocity_noise=config.velocity_noise,
        packet_loss=config.packet_loss,
        observation_delay=delay(config.observation_delay),
        action_delay=delay(config.action_delay),
    )


def edge_cases(config: WorldConfig) -> Iterator[tuple[str, WorldConfig, str]]:
    """Name, ranges and `edge` of `draw_world` for each end of each range, and for all ranges at their ends."""
    for name in (*_INTERVALS, *_DELAYS):
        minimum, maximum = getattr(config, name)
        if minimum != maximum:
            for value in (minimum, maximum):
                yield f"{name}={value:g}", dataclasses.replace(config, **{name: [value, value]}), ""
    for edge in ("minimum", "maximum", "corners"):
        yield f"all: {edge}", config, edge
