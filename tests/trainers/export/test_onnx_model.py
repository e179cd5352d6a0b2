"""ONNX models of functions with loops and of operations that jax2onnx lacks."""

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

from mimic.trainers.export import onnx_model
from mimic.trainers.export.onnx_model import to_onnx


def loop(x):
    """Two carried vectors, a constant of each input, and a value that nothing reads."""

    def step(_, carried):
        first, second, unread = carried
        return first * 0.5 + second, jnp.sin(first) + x, unread + 1

    return jax.lax.fori_loop(0, 4, step, (x, 2 * x, jnp.zeros(())))[0]


def rows(x):
    """Rows at positions that depend on the input, or not; a choice between truth values; repetitions and padding."""
    matrix = x.reshape(3, 2)
    first, *_ = jnp.unstack(matrix, axis=1)
    smallest = jnp.argmin(first)
    positive = jnp.where(first > 0, first > matrix[:, 1], first < 1)
    taken = jnp.concatenate([matrix[smallest], matrix[jnp.array([2, 0])].ravel(), jnp.diagonal(matrix[:2])])
    sorted_rows = matrix[jnp.argsort(first)]
    parts = [taken, positive.astype(jnp.float32), positive[smallest][None] * 2.0, sorted_rows.ravel()]
    return jnp.tile(jnp.pad(jnp.concatenate(parts), (1, 2), constant_values=3), 2) + jnp.stack([x[0], x[1]])[1]


def test_the_model_is_the_function():
    model = to_onnx(
        lambda x: {"loop": loop(x), "rows": rows(x)},
        name="model",
        inputs={"x": 6},
        metadata={"unit": "rad"},
    )
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    x = np.random.default_rng(1).normal(size=(5, 6)).astype(np.float32)
    for function, actual in zip((loop, rows), session.run(["loop", "rows"], {"x": x}), strict=True):
        np.testing.assert_allclose(actual, jax.vmap(function)(x), rtol=1e-5, atol=1e-6)
    assert session.get_modelmeta().custom_metadata_map == {"unit": "rad"}
    assert session.get_inputs()[0].shape[0] == "batch"


def test_a_model_with_other_values_is_rejected(monkeypatch):
    monkeypatch.setitem(onnx_model._COMPOSED, "tile", lambda arguments, params, results: [jnp.zeros(results[0].shape)])
    with pytest.raises(ValueError, match="onnx: y: expected the values of JAX to 1e-05, got a median error of "):
        to_onnx(lambda x: {"y": jnp.tile(x, 2)}, name="model", inputs={"x": 3})


def test_a_loop_with_a_value_for_each_step_is_rejected():
    def function(x):
        return {"y": jax.lax.scan(lambda carried, _: (carried + x, carried), x, None, length=3)[1][2]}

    with pytest.raises(NotImplementedError, match="onnx: expected a loop without values for each step"):
        to_onnx(function, name="model", inputs={"x": 6})
