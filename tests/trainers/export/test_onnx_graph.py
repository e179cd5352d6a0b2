"""ONNX graphs of functions with loops and of operations that a version of JAX may use."""

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

from mimic.trainers.export.onnx_graph import to_onnx


def loop(x):
    """Two carried vectors, a constant of each input, and a value that nothing reads."""

    def step(_, carried):
        first, second, unread = carried
        return first * 0.5 + second, jnp.sin(first) + x, unread + 1

    return jax.lax.fori_loop(0, 4, step, (x, 2 * x, jnp.zeros(())))[0]


def scan_without_values(x):
    return jax.lax.scan(lambda carried, _: (jnp.cos(carried) + x, None), x, None, length=3)[0]


def unstacked(x):
    rows = jnp.unstack(x.reshape(2, 3), axis=0)
    columns = jnp.unstack(x.reshape(2, 3), axis=1)
    return jnp.concatenate([rows[1] * rows[0], columns[2] - columns[0]])


@pytest.mark.parametrize("function", [loop, scan_without_values, unstacked])
def test_the_graph_is_the_function(function):
    model = to_onnx(lambda x: {"y": function(x)}, name="graph", inputs={"x": 6}, metadata={})
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    x = np.random.default_rng(0).normal(size=(5, 6)).astype(np.float32)
    (actual,) = session.run(["y"], {"x": x})
    np.testing.assert_allclose(actual, jax.vmap(function)(x), rtol=1e-5, atol=1e-6)


def test_a_loop_with_a_value_for_each_step_is_rejected():
    def function(x):
        return {"y": jax.lax.scan(lambda carried, _: (carried + x, carried), x, None, length=3)[1][2]}

    with pytest.raises(NotImplementedError, match="onnx: expected a loop without values for each step"):
        to_onnx(function, name="graph", inputs={"x": 6}, metadata={})
