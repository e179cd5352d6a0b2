"""Trained networks that come with the package: a policy and a pose mapper of each environment."""

from pathlib import Path

NETWORKS = Path(__file__).parent / "networks"


def pretrained_names(kind: str) -> tuple[str, ...]:
    """The environments with a trained network of this kind, "policy" or "pose_mapper"."""
    return tuple(sorted(path.name.removesuffix(f"-{kind}") for path in NETWORKS.glob(f"*-{kind}")))
