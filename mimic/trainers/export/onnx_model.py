"""Conversion of JAX functions to ONNX models, by jax2onnx, checked with ONNX Runtime.

jax2onnx is given what JAX traced of a function, so that it sees JAX's primitives alone, and not the functions of
`jax.numpy` and flax, which it would replace by its own while it traces. Primitives that it lacks, or converts wrongly
where the batch size is not known, are composed of others first: see `_COMPOSED`.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import jaxpr_as_fun

from mimic.base import compat

OPSET, IR_VERSION = 18, 8  # of 2022: all runtimes since then read them
TOLERANCE = 1e-5  # of float32, with sums in another order
# Where two candidates of a mapper are equally good, or an angle is at the seam of the circle, rounding decides.
_EQUAL_SAMPLES, _SAMPLES = 0.75, 32


def to_onnx(
    function: Callable[..., Mapping[str, jax.Array]],
    *,
    name: str,
    inputs: Mapping[str, int],
    metadata: Mapping[str, str] | None = None,
) -> bytes:
    """Converts a function of float32 vectors to an ONNX model of inputs [batch, length].

    Args:
      function: maps a vector for each input to the named output vectors.
      name: name of the graph.
      inputs: length of the vector of each input.
      metadata: `metadata_props` of the model.

    Raises:
      ValueError: the model's outputs are not those of the function.
      NotImplementedError: the function uses an operation that jax2onnx does not know.
    """
    jax2onnx = compat.import_jax2onnx()  # needs the extra "export", as the imports below
    import onnx_ir
    from onnx import helper
    from onnx_ir.passes.common import RemoveUnusedNodesPass

    vectors = [jax.ShapeDtypeStruct((size,), jnp.float32) for size in inputs.values()]
    traced, shapes = jax.make_jaxpr(function, return_shape=True)(*vectors)
    outputs = sorted(shapes)  # as JAX sorts the keys of a dict
    single = jaxpr_as_fun(jax.make_jaxpr(lambda *vectors: _run(traced.jaxpr, traced.consts, vectors))(*vectors))

    def batched(*arrays: jax.Array) -> Sequence[jax.Array]:
        return jax.vmap(lambda *vectors: tuple(single(*vectors)))(*arrays)

    model = jax2onnx.to_onnx(
        batched,
        [("batch", size) for size in inputs.values()],
        model_name=name,
        opset=OPSET,
        input_names=list(inputs),
        output_names=outputs,
    )
    model = onnx_ir.to_proto(RemoveUnusedNodesPass()(onnx_ir.from_proto(model)).model)
    del model.graph.value_info[:]  # shapes that runtimes infer; some of jax2onnx's are wrong
    model.ir_version, model.producer_name = IR_VERSION, "mimic"
    helper.set_model_props(model, dict(metadata or {}))
    content = model.SerializeToString()
    rng = np.random.default_rng(0)
    samples = {key: rng.normal(size=(_SAMPLES, size)).astype(np.float32) for key, size in inputs.items()}
    _check(content, function, samples)
    return content


def _check(
    content: bytes,
    function: Callable[..., Mapping[str, jax.Array]],
    inputs: Mapping[str, np.ndarray],
) -> None:
    """Raises a `ValueError` unless ONNX Runtime computes the function."""
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    actual = session.run(None, dict(inputs))
    expected = jax.jit(jax.vmap(function))(*inputs.values())
    for output, values in zip(session.get_outputs(), actual, strict=True):
        reference = np.asarray(expected[output.name])
        if values.shape != reference.shape:
            raise ValueError(f"onnx: {output.name}: expected the shape {reference.shape} of JAX, got {values.shape}")
        error = np.abs(values - reference).max(axis=1) / max(1.0, float(np.abs(reference).max()))
        if not np.mean(error <= TOLERANCE) >= _EQUAL_SAMPLES:  # not a number is an error too
            raise ValueError(
                f"onnx: {output.name}: expected the values of JAX to {TOLERANCE:g}, got a median error of "
                f"{np.median(error):g}"
            )


def _run(jaxpr: Any, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
    """Runs a traced function without functions in it, and with `_COMPOSED` operations."""
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True))

    def value(variable: Any) -> Any:
        return variable.val if hasattr(variable, "val") else values[variable]

    for equation in jaxpr.eqns:
        arguments = [value(variable) for variable in equation.invars]
        is_constant = not any(isinstance(argument, Tracer) for argument in arguments)
        with jax.ensure_compile_time_eval() if is_constant else contextlib.nullcontext():
            results = _apply(equation, arguments)
        values.update(zip(equation.outvars, results, strict=True))
    return [value(variable) for variable in jaxpr.outvars]


def _apply(equation: Any, arguments: list[Any]) -> Sequence[Any]:
    primitive, params = equation.primitive, equation.params
    if primitive.name in _COMPOSED:
        return _COMPOSED[primitive.name](arguments, params, [variable.aval for variable in equation.outvars])
    inner = params.get("jaxpr", params.get("call_jaxpr"))
    if inner is not None:
        return _run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", []), arguments)
    results = primitive.bind(*arguments, **params)
    return results if primitive.multiple_results else [results]


def _stack(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    axis = params["axis"]
    return [lax.concatenate([lax.expand_dims(value, [axis]) for value in arguments], axis)]


def _select(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    """Runtimes have no choice between truth values."""
    condition, if_false, if_true = arguments
    if results[0].dtype == bool:
        return [(condition & if_true) | (~condition & if_false)]
    return [lax.select_n(condition, if_false, if_true)]


def _dynamic_slice(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    """A row at a position along an axis: a product with ones and zeros."""
    values, *starts = arguments
    sizes = params["slice_sizes"]
    axes = [axis for axis, size in enumerate(sizes) if size != values.shape[axis]]
    if [sizes[axis] for axis in axes] != [1]:
        raise NotImplementedError(f"onnx: expected one row of {values.shape}, got {sizes}")
    (axis,) = axes
    rows = jnp.moveaxis(values, axis, 0)
    is_at = (jnp.reshape(starts[axis], (1, 1)) == np.arange(len(rows))).astype(values.dtype)
    row = jnp.matmul(is_at, rows.reshape(len(rows), -1), precision="highest")
    return [jnp.moveaxis(row.reshape(1, *rows.shape[1:]), 0, axis)]


# jax2onnx 0.13 has no stack, and converts the others wrongly where the batch size is not known.
_COMPOSED: dict[str, Callable[[list[Any], Mapping[str, Any], Sequence[Any]], Sequence[Any]]] = {
    "dynamic_slice": _dynamic_slice,
    "select_n": _select,
    "stack": _stack,
}
