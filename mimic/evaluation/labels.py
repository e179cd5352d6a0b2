"""Keys and display names of splits, measures of similarity and baselines."""

import math
from collections.abc import Mapping

SPLITS = ("train", "held_out")
ALL_KINDS = "all"
SIMILARITY_HEADERS = {  # of tables and pictures; positions in chain lengths
    "centre_line_distance": "centre\nline",
    "tangent_angle_deg": "tangent\nangle",
    "frechet_distance": "Frechet\ndistance",
    "hand_position_error": "hand\nposition",
    "hand_rotation_deg": "hand\nrotation",
}
_IN_METRES = {"hand_position_mm": "hand\nposition"}  # of arms whose bases are placed
SPLIT_NAMES = {"train": "training", "held_out": "held out"}
SIMILARITY_NAMES = {  # display names that differ from their keys
    "nearest_poses": "nearest poses (metric)",
    "copy_joints": "copying shared joints",
    "hand_ik": "IK of the scaled hand",
    "hold_home": "holding start pose",
    "controller": "without learning",
}


def similarity_texts(similarity: Mapping[str, float]) -> dict[str, tuple[str, str]]:
    """Label and value of each known measure of one moment by its name, as the viewer and videos show them."""

    def text(name: str) -> str:
        value = similarity[name]
        if name.endswith("_mm"):
            return f"{value:.0f} mm"
        return f"{value:.0f}°" if name.endswith("_deg") else f"{value:.3f}"

    headers = SIMILARITY_HEADERS | _IN_METRES
    known = {name: header for name, header in headers.items() if not math.isnan(similarity.get(name, math.nan))}
    return {name: (header.replace("\n", " "), text(name)) for name, header in known.items()}
