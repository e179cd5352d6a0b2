"""The config of a world: how the learner's surroundings and its hardware differ from the ideal arm of the paper."""

import dataclasses
from typing import Any

from mimic.base.config import check_choice
from mimic.base.ranges import check_ranges, number

PHYSICS = ("mjx", "fused")
AUTO = "auto"  # chooses one of them, see `choose_physics`
MAX_DELAY = 3  # ticks


def _interval(minimum: float, maximum: float, *, at_least: float, at_most: float) -> Any:
    """Field for [minimum, maximum] of a number that is drawn for each episode."""
    return number(lambda: [minimum, maximum], at_least=at_least, at_most=at_most, entries=(2, 2))


@dataclasses.dataclass(frozen=True)
class WorldConfig:
    """Gravity, friction, load, sensors and delays. Ranges are drawn from uniformly at the start of each episode.

    The default is an ideal world, without any of it. A tick is a control step of the environment.

    Attributes:
      gravity: whether there is gravity. The robot compensates the weight of its links and of its payload.
      gravity_error: range of the part of the weight that the compensation lacks, as a fraction.
      payload: range of the mass at the tip [kg].
      payload_lever: range of the distance of its centre of mass from the end of the last link, along the link [m].
      link_mass: range of the factor on mass and inertia of each link; another one for each link.
      friction: range of the factor on the joints' friction, another one for each joint, see `JointFriction`.
      motor_gain: range of the ratio of the torque that acts to the commanded one; another one for each joint.
      position_bias: maximum of the constant error of each measured angle [rad].
      position_noise, velocity_noise: standard deviation of each angle [rad] and velocity [rad/s] that the policy
        observes; on the virtual robot, also of those that the inner loop measures.
      observation_delay: range of the age of a measurement when the policy observes it, in ticks.
      action_delay: range of the time from an observation to the moment when its action acts, in ticks.
      action_latency: time from the arrival of an action until it acts, in addition to whole ticks [s]. The safety layer
        of `mimic.deploy` takes 0.02 s to check a target; there the time is always that one.
      packet_loss: probability that an action does not arrive; the one before is then used again.
      start_noise: maximum deviation of each joint from the start pose [rad].
      expert: what the policy observes of the expert: "exact", its link states; "links", measured ones; or "points",
        measured positions and velocities of the link frames alone. The reward always compares the true states.
      expert_noise: range of the standard deviation of each measured position [chain lengths] and direction; velocities
        are differences of two measurements. Only where the expert is measured, as the next two.
      expert_loss: probability that a tick of the expert is missing.
      hidden_links: range of the number of the expert's links that are hidden, others in each episode.
      history: number of past ticks whose measured motion and actions the policy observes beside the present, so that it
        can tell what was drawn.
      stops: whether joints have mechanical stops at the ends of their ranges.
      contacts: whether links touch each other and the floor. Only of `physics=mjx` and of the virtual robot.
      floor_height: of the floor in the base frame [m], negative for a robot on a pedestal.
    """

    gravity: bool = False
    gravity_error: list[float] = _interval(0.0, 0.0, at_least=-1.0, at_most=1.0)
    payload: list[float] = _interval(0.0, 0.0, at_least=0.0, at_most=1000.0)
    payload_lever: list[float] = _interval(0.0, 0.0, at_least=0.0, at_most=10.0)
    link_mass: list[float] = _interval(1.0, 1.0, at_least=0.1, at_most=10.0)
    friction: list[float] = _interval(0.0, 0.0, at_least=0.0, at_most=100.0)
    motor_gain: list[float] = _interval(1.0, 1.0, at_least=0.1, at_most=10.0)
    position_bias: float = number(0.0, at_least=0.0, at_most=1.0)
    position_noise: float = number(0.0, at_least=0.0, at_most=1.0)
    velocity_noise: float = number(0.0, at_least=0.0, at_most=10.0)
    observation_delay: list[int] = number(lambda: [0, 0], at_least=0, at_most=MAX_DELAY, entries=(2, 2))
    action_delay: list[int] = number(lambda: [0, 0], at_least=0, at_most=MAX_DELAY, entries=(2, 2))
    action_latency: float = number(0.0, at_least=0.0, at_most=1.0)
    packet_loss: float = number(0.0, at_least=0.0, below=1.0)
    start_noise: float = number(0.0, at_least=0.0, at_most=1.0)
    expert: str = "exact"
    expert_noise: list[float] = _interval(0.0, 0.0, at_least=0.0, at_most=1.0)
    expert_loss: float = number(0.0, at_least=0.0, below=1.0)
    hidden_links: list[int] = number(lambda: [0, 0], at_least=0, at_most=100, entries=(2, 2))
    history: int = number(0, at_least=0, at_most=100)
    stops: bool = False
    contacts: bool = False
    floor_height: float = number(0.0, at_least=-100.0, at_most=100.0)

    def __post_init__(self) -> None:
        check_ranges(self, "world.")
        check_choice("world.expert", self.expert, ("exact", "links", "points"))
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list) and value[0] > value[1]:
                raise ValueError(f"world.{field.name}: expected [minimum, maximum], got {value}")
        if (any(self.gravity_error) or self.contacts) and not self.gravity:
            raise ValueError("world: expected gravity=true with gravity_error or contacts, got gravity=false")
        if self.expert == "exact" and (any(self.expert_noise) or self.expert_loss or any(self.hidden_links)):
            raise ValueError(
                "world.expert: expected links or points with expert_noise, expert_loss or hidden_links, got exact"
            )
