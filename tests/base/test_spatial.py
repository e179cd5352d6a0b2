import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.base import spatial

AXES = [(0.0, 0.0, 1.0), (2 / 3, -1 / 3, 2 / 3)]


def test_constant_zeros_are_not_computed():
    def turn(axis):
        return jax.make_jaxpr(lambda angle: jnp.stack([*map(jnp.asarray, spatial.axis_rotation(axis, angle)[0])]))(0.3)

    assert "mul" in str(turn(AXES[-1]))
    assert "mul" not in str(turn(AXES[0]))
    assert spatial.dot((0.0, 1.0, 0.0), ("unused", 2.0, "unused")) == 2.0


def test_vector_of_a_numpy_array_is_constant():
    assert spatial.vector(np.array([0.0, 1.0, 2.0])) == (0.0, 1.0, 2.0)
    assert all(type(x) is float for x in spatial.vector(np.array([0.0, 1.0, 2.0])))  # np.float64 would promote float32


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-23, 1e-20, 1e-19, 1e-10, 1.0, 1e18])
def test_norm_has_a_finite_gradient_at_and_near_the_kink(dtype, size):
    norm = lambda x: spatial.norm(spatial.vector(x))  # noqa: E731
    value, gradient = jax.jit(jax.value_and_grad(norm))(jnp.asarray([size, 0, 0], dtype))
    assert value.dtype == gradient.dtype == dtype
    assert np.isfinite(value) and np.all(np.isfinite(gradient))
    if size**2 > float(jnp.finfo(dtype).tiny):
        np.testing.assert_allclose([value, gradient[0]], [size, 1], rtol=1e-6)  # a few float32 roundings
    else:
        assert value == 0 and not gradient.any()


def test_norm_of_a_constant_vector():
    assert spatial.norm((3.0, 0.0, -4.0)) == 5.0
