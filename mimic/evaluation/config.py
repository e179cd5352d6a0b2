"""The config of a search for optimal torques."""

import dataclasses

from mimic.base.ranges import check_ranges, number


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """A search for optimal torques, see `search_torques`.

    Attributes:
      iterations: updates of each torque sequence.
      starts: initial torque sequences for each demonstration: those of the policy, computed_torque, pd and hold in this
        order, then of the policy with noise.
    """

    iterations: int = number(40, at_least=1, at_most=100_000)
    starts: int = number(8, at_least=1, at_most=1000)

    def __post_init__(self) -> None:
        check_ranges(self, "search.")
