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


def open_session(path: Path | bytes, inputs: dict[str, int], outputs: dict[str, int]) -> "onnxruntime.InferenceSession":
    """A session on one thread.

    Args:
      path: ONNX file, or its content.
      inputs, outputs: expected lengths of the vectors, by name.

    Raises:
      ValueError: a file that onnxruntime cannot read, or with other inputs or outputs.
    """
    import onnxruntime  # here, as bundles are written where it is not installed

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    name = "policy" if isinstance(path, bytes) else path.name
    try:
        content = path if isinstance(path, bytes) else read_bytes(path)
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

    Attributes:
      observed: [4, robots, joints] what `evaluate` reads: measured angles and velocities, then those of the references
        [rad, rad/s].
    """

    def __init__(self, bundle: Bundle, motions: Sequence[int]):
        joints, size, robots = bundle.num_joints, bundle.action_size, len(motions)
        self._features, self._row = _expert_features(bundle, motions)
        self.observed = np.zeros((4, robots, joints), np.float32)
        self._inputs = {
            "past_actions": np.zeros((robots, bundle.past_actions * size), np.float32),
            "features": np.zeros((robots, bundle.features), np.float32),
            **dict(zip(_OBSERVED, self.observed, strict=True)),
        }
        self._action = np.zeros((robots, size), np.float32)
        sizes = {name: array.shape[-1] for name, array in self._inputs.items()}
        self._session = open_session(bundle.folder / POLICY, sizes, {"action": size})
        self._binding = _bind(self._session, self._inputs, {"action": self._action})
        self._last, self._size = bundle.ticks, size
        self._tick: int | None = None  # of the features

    def act(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> np.ndarray:
        """The actions [robots, numbers] at a tick, of measured and reference motions [robots, joints]."""
        for observed, values in zip(self.observed, (qpos, qvel, reference.qpos, reference.qvel), strict=True):
            observed[:] = values
        action = self.evaluate(tick).astype(float)
        self.remember()
        return action

    def evaluate(self, tick: int) -> np.ndarray:
        """The actions [robots, numbers] at a tick, of what is observed; the next call overwrites them."""
        if tick != self._tick:
            features = self._features[min(tick, self._last)]
            np.take(features, self._row, axis=0, out=self._inputs["features"], mode="clip")
            self._tick = tick
        self._session.run_with_iobinding(self._binding)
        return self._action

    def remember(self) -> None:
        """Makes the last actions the newest of the past ones that the policy observes."""
        past, size = self._inputs["past_actions"], self._size
        if past.size:
            past[:, size:] = past[:, :-size]
            past[:, :size] = self._action


def _bind(
    session: "onnxruntime.InferenceSession", inputs: dict[str, np.ndarray], outputs: dict[str, np.ndarray]
) -> "onnxruntime.IOBinding":
    """Lets a session read and write these arrays, which costs less in each run than arguments and results."""
    from onnxruntime import OrtValue

    binding = session.io_binding()
    for bind, arrays in ((binding.bind_ortvalue_input, inputs), (binding.bind_ortvalue_output, outputs)):
        for name, array in arrays.items():
            bind(name, OrtValue.ortvalue_from_numpy(array))
    return binding


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
