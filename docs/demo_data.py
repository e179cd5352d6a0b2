"""Writes the data of the demo page: a pose mapper with its arms and its metric, as a script that calls `mimicDemo.add`.

    python docs/demo_data.py DIR

Pages that are opened from the disk cannot fetch JSON, but can load scripts. `docs/hooks.py` adds them to the site.
"""

import base64
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

FIRST = "panda4dof"  # the environment that the page shows first


def scripts() -> dict[str, str]:
    """The scripts by name: a mapper of each environment, and "start", which starts the page."""
    from mimic.trainers.pretrained import pretrained_names

    names = sorted(pretrained_names("pose_mapper"), key=lambda name: (name != FIRST, name))
    start = f'mimicDemo.start(document.getElementById("mimic-demo"), {json.dumps(names)});\n'
    return {"start": start} | {name: f"mimicDemo.add({json.dumps(demo_data(name))});\n" for name in names}


def demo_data(name: str) -> dict[str, Any]:
    """What docs/demo/arms.js needs of the mapper of an environment.

    Raises:
      ValueError: a mapper or metric that the page does not compute.
    """
    import mimic

    network = mimic.load(name, "pose_mapper")
    assert isinstance(network.function, mimic.PoseMapper)
    model, params = network.function.model, network.function.params["params"]
    config, metric = model.config, model.metric
    if (
        (config.inputs, config.outputs, config.activation) != ("link_states", "circle", "gelu")
        or not metric.is_static
        or metric.hand_weights.position
    ):
        raise ValueError(f"{name}: expected a mapper of the preset large and a static metric, got {config}")
    kernels = [params[f"Dense_{i}"] for i in range(len(params))]
    return {
        "name": name,
        "expert": _arm(model.expert),
        "learner": _arm(model.learner),
        "correspondence": np.asarray(metric.correspondence).tolist(),
        "weights": {
            "translation": float(metric.weights.translation),  # type: ignore[union-attr]
            "rotation": float(metric.weights.rotation),  # type: ignore[union-attr]
            "hand": float(metric.hand_weights.rotation),
        },
        "heads": config.heads,
        "layers": [{part: _base64(layer[part]) for part in ("kernel", "bias")} for layer in kernels],
        "held_out": {
            "mapper": network.report["mean_distance"]["held_out"],
            "search": network.report["optimal_distance"]["held_out"],
            "copy": network.report["copying_distance"]["held_out"],
        },
    }


def _arm(arm: Any) -> dict[str, Any]:
    from mimic.arms.pose_limits import continuous_joints

    joint = np.asarray(arm.link_joint)
    arrays = {
        "joint_axis": arm.joint_axis,
        "joint_anchor": arm.joint_anchor,
        "joint_range": arm.joint_range,
        "link_joint": joint,
        "link_position": arm.link_position,
        "link_direction": arm.link_rotation[:, :, 0],
        "hand_joint": arm.hand_joint[0],
        "hand_axes": arm.hand_rotation[0].T,
        "segment_joint": joint[list(arm.segment_link)],
        "segment_start": arm.segment_start,
        "segment_end": arm.segment_end,
        "continuous": continuous_joints(arm),
        "chain_length": arm.chain_length,
    }
    names = {"name": arm.name, "joint_names": list(arm.joint_names)}
    return {**names, **{key: np.asarray(value).tolist() for key, value in arrays.items()}}


def _base64(array: Any) -> str:
    return base64.b64encode(np.asarray(array, "<f4").tobytes()).decode()


if __name__ == "__main__":
    for environment, script in scripts().items():
        (Path(sys.argv[1]) / f"{environment}.js").write_text(script)
