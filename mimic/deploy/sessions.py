"""The networks of a bundle, run by onnxruntime on one thread."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnxruntime

from mimic.control.joint_control import Reference
from mimic.deploy.bundle import CLEARANCE, POLICY, Bundle


def open_session(path: Path | bytes, inputs: dict[str, int], outputs: dict[str, int]) -> onnxruntime.InferenceSession:
    """A session on one thread.

    Args:
      path: ONNX file, or its content.
      inputs, outputs: expected lengths of the vectors, by name.

    Raises:
      ValueError: a file that onnxruntime cannot read, or with other inputs or outputs.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    name = "policy" if isinstance(path, bytes) else path.name
    try:
        content = path if isinstance(path, bytes) else str(path)
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common class
        line = " ".join(str(error).split())[:200]
        raise ValueError(f"bundle: {name}: expected an ONNX model: {line}") from error
    for kind, expected, nodes in (
        ("inputs", inputs, session.get_inputs()),
        ("outputs", outputs, session.get_outputs()),
    ):
        sizes = {node.name: node.shape[-1] for node in nodes}
        if sizes != expected:
            raise ValueError(f"bundle: {name}: {kind}: expected {_text(expected)}, got {_text(sizes)}")
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
        expert_size = (bundle.preview + 1) * bundle.expert.shape[-1]
        inputs = {name: joints for name in ("qpos", "qvel", "reference_qpos", "reference_qvel")}
        inputs |= {"past_actions": bundle.past_actions * size, "expert": expert_size}
        self._session = open_session(bundle.folder / POLICY, inputs, {"action": size})
        self._expert = bundle.expert[list(motions)]
        self._preview, self._last = bundle.preview, bundle.ticks
        self._past = np.zeros((len(motions), bundle.past_actions * size), np.float32)
        self._size = size

    def act(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> np.ndarray:
        """The actions [robots, numbers] at a tick, of measured and reference motions [robots, joints]."""
        steps = np.minimum(np.arange(tick, tick + self._preview + 1), self._last)
        observation = {
            "qpos": qpos,
            "qvel": qvel,
            "reference_qpos": reference.qpos,
            "reference_qvel": reference.qvel,
            "past_actions": self._past,
            "expert": self._expert[:, steps].reshape(len(self._past), -1),
        }
        feed = {name: np.ascontiguousarray(value, np.float32) for name, value in observation.items()}
        (action,) = self._session.run(["action"], feed)
        if self._past.size:
            self._past = np.concatenate([action, self._past[:, : -self._size]], axis=1)
        return np.asarray(action, float)


class Clearance:
    """The clearance [m] of the arm of a bundle in poses [rows, joints]."""

    def __init__(self, bundle: Bundle):
        self._session = open_session(bundle.folder / CLEARANCE, {"qpos": bundle.num_joints}, {"clearance": 1})

    def __call__(self, qpos: np.ndarray) -> np.ndarray:
        """The clearances [rows]."""
        (clearance,) = self._session.run(["clearance"], {"qpos": np.ascontiguousarray(qpos, np.float32)})
        return clearance[:, 0]
