"""The config of a search for optimal torques."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """A search for optimal torques, see `search_torques`.

    Attributes:
      iterations: updates of each torque sequence.
      starts: initial torque sequences for each demonstration: those of the policy, computed_torque, pd and hold in this
        order, then of the policy with noise.
    """

    iterations: int = 40
    starts: int = 8

    def __post_init__(self) -> None:
        for name in ("iterations", "starts"):
            if getattr(self, name) < 1:
                raise ValueError(f"search.{name}: expected at least 1, got {getattr(self, name)}")
