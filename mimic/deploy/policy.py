"""The networks of a bundle, run by onnxruntime on one thread."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mimic.base.files import read_bytes
from mimic.control.joint_control import Reference
from mimic.deploy.bundle import FEATURES, POLICY, Bundle

if TYPE_CHECKING:
    import onnxruntime

_OBSERVED = "qpos", "qvel", "reference_qpos", "reference_qvel"


def open_session(path: Path, inputs: dict[str, int], outputs: dict[str, int]) -> "onnxruntime.InferenceSession":
    """A session on one thread.

    Args:
      path: ONNX file.
      inputs, outputs: expected lengths of the vectors, by name.

    Raises:
      ValueError: a file that onnxruntime cannot read, or with other inputs or outputs.
    """
    import onnxruntime  # here, as bundles are written where it is not installed

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(read_bytes(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common class
        line = " ".join(str(error).split())[:200]
        raise ValueError(f"bundle: {path.name}: expected an ONNX model: {line}") from error
    for kind, expected, nodes in (
        ("inputs", inputs, session.get_inputs()),
        ("outputs", outputs, session.get_outputs()),
    ):
        sizes = {node.name: node.shape[-1] for node in nodes}
        if sizes != expected:
            raise ValueError(f"bundle: {path.name}: {kind}: expected {_text(expected)}, got {_text(sizes)}")
    return session


def _text(sizes: dict[str, int]) -> str:
    return ", ".join(f"{name} [{size}]" for name, size in sorted(sizes.items()))


class Policy:
    """The policy of a bundle on some motions, one for each robot of a batch.

    Args:
      bundle: see `load_bundle`.
      motions: indices of the motions.
    """

    def __init__(self, bundle: Bundle, motions: Sequence[int]):
        joints, size = bundle.num_joints, bundle.action_size
        self._features, self._row = _expert_features(bundle, motions)
        self._past = np.zeros((len(motions), bundle.past_actions * size), np.float32)
        sizes = dict.fromkeys(_OBSERVED, joints) | {"past_actions": self._past.shape[1], "features": bundle.features}
        self._session = open_session(bundle.folder / POLICY, sizes, {"action": size})

    def act(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> np.ndarray:
        """The actions [robots, numbers] at a tick, of measured and reference motions [robots, joints]."""
        features = self._features[min(tick, len(self._features) - 1)][self._row]
        observed = dict(zip(_OBSERVED, (qpos, qvel, reference.qpos, reference.qvel), strict=True))
        feed = observed | {"past_actions": self._past, "features": features}
        (action,) = self._session.run(["action"], {name: np.asarray(x, np.float32) for name, x in feed.items()})
        action = np.asarray(action)
        self._past = np.concatenate([action, self._past], axis=1)[:, : self._past.shape[1]]
        return action.astype(float)


def _expert_features(bundle: Bundle, motions: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """What the policy computes from the expert alone, [ticks + 1, motions, numbers], and the motion of each robot.

    At a tick these are the expert's states now and at the later ticks of the preview; its last state stays.
    """
    size = (bundle.preview + 1) * bundle.expert.shape[-1]
    session = open_session(bundle.folder / FEATURES, {"expert": size}, {"features": bundle.features})
    different, row = np.unique(motions, return_inverse=True)
    ticks = np.arange(bundle.ticks + 1)
    steps = np.minimum(ticks[:, None] + np.arange(bundle.preview + 1), bundle.ticks)
    rows = [
        session.run(["features"], {"expert": x[steps].reshape(len(ticks), -1)})[0] for x in bundle.expert[different]
    ]
    return np.stack(rows, axis=1), row
