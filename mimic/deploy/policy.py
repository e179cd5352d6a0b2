"""The network of a bundle, run by onnxruntime on one thread."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mimic.base.files import read_bytes
from mimic.control.joint_control import Reference
from mimic.deploy.bundle import POLICY, Bundle

if TYPE_CHECKING:
    import onnxruntime

OBSERVED = "qpos", "qvel", "reference_qpos", "reference_qvel"  # measured motion, and that of the inner loop


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
        joints = bundle.num_joints
        self._expert, self._preview = bundle.expert[np.asarray(motions)], np.arange(bundle.preview + 1)
        self._past = np.zeros((len(motions), bundle.past_actions * joints), np.float32)
        sizes = dict.fromkeys(OBSERVED, joints) | {"past_actions": self._past.shape[1]}
        sizes["expert"] = len(self._preview) * bundle.expert_numbers
        self._session = open_session(bundle.folder / POLICY, sizes, {"action": joints})

    def act(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> np.ndarray:
        """The actions [robots, numbers] at a tick, of measured and reference motions [robots, joints]."""
        ahead = np.minimum(tick + self._preview, self._expert.shape[1] - 1)  # the expert's last state stays
        feed = dict(zip(OBSERVED, (qpos, qvel, reference.qpos, reference.qvel), strict=True))
        feed |= {"past_actions": self._past, "expert": self._expert[:, ahead].reshape(len(self._past), -1)}
        (action,) = self._session.run(["action"], {name: np.asarray(x, np.float32) for name, x in feed.items()})
        action = np.asarray(action)
        self._past = np.concatenate([action, self._past], axis=1)[:, : self._past.shape[1]]
        return action.astype(float)
