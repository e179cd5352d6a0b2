"""ONNX models of operations that jax2onnx lacks."""

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

from mimic.trainers.export import onnx_model
from mimic.trainers.export.onnx_model import to_onnx


def rows(x):
    """A row at a position that depends on the input, a choice, and a sum of columns."""
    matrix = x.reshape(3, 2)
    smallest = jnp.argmin(matrix[:, 0])
    chosen = jnp.where(matrix[0] > 0, jnp.where(x[0] > x[1], matrix[1] > 0, matrix[2] > 0), matrix[1] < 1)
    return jnp.concatenate([matrix[smallest], chosen.astype(jnp.float32), jnp.stack([x[0], x[1]], axis=-1) * 2.0])


def test_the_model_is_the_function():
    model = to_onnx(
        lambda x: {"rows": rows(x), "sine": jnp.sin(x)},
        name="model",
        inputs={"x": 6},
        metadata={"unit": "rad"},
    )
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    x = np.random.default_rng(1).normal(size=(5, 6)).astype(np.float32)
    for function, actual in zip((rows, jnp.sin), session.run(["rows", "sine"], {"x": x}), strict=True):
        np.testing.assert_allclose(actual, jax.vmap(function)(x), rtol=1e-5, atol=1e-6)
    assert session.get_modelmeta().custom_metadata_map == {"unit": "rad"}
    assert session.get_inputs()[0].shape[0] == "batch"


def test_a_model_with_other_values_is_rejected(monkeypatch):
    monkeypatch.setitem(onnx_model._COMPOSED, "stack", lambda arguments, params, results: [jnp.zeros(results[0].shape)])
    with pytest.raises(ValueError, match="onnx: y: expected the values of JAX to 1e-05, got a median error of "):
        to_onnx(lambda x: {"y": jnp.stack([x, x])[0]}, name="model", inputs={"x": 3})


def test_several_rows_at_a_position_are_rejected():
    with pytest.raises(NotImplementedError, match="onnx: expected one row of "):
        to_onnx(lambda x: {"y": jax.lax.dynamic_slice(x, [jnp.argmin(x)], [2])}, name="model", inputs={"x": 6})
