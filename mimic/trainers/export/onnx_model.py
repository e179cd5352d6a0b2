"""Conversion of JAX functions to ONNX models, by jax2onnx, checked with ONNX Runtime.

jax2onnx is given what JAX traced of a function, so that it sees JAX's primitives alone, and not the functions of
`jax.numpy` and flax, which it would replace by its own while it traces. Primitives that it lacks, or converts wrongly
where the batch size is not known, are composed of others first: see `_composed`.
"""

import contextlib
import math
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
    """Runs a traced function without functions in it, and with `_composed` operations."""
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
    if primitive.name == "cond" and params.get("branches_platforms"):  # a function with another form on TPUs
        default = params["branches"][params["branches_platforms"].index(None)]
        return _run(default.jaxpr, default.consts, arguments[1:])
    inner = params.get("jaxpr", params.get("call_jaxpr"))
    if inner is not None:
        return _run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", []), arguments)
    results = primitive.bind(*arguments, **params)
    return results if primitive.multiple_results else [results]


def _stack(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    axis = params["axis"]
    return [lax.concatenate([lax.expand_dims(value, [axis]) for value in arguments], axis)]


def _tile(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    (values,) = arguments
    for axis, count in enumerate(params["reps"]):
        values = lax.concatenate([values] * count, axis) if count > 1 else values
    return [values]


def _unstack(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    return [lax.index_in_dim(arguments[0], i, params["axis"], keepdims=False) for i in range(len(results))]


def _pad(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    values, filling = arguments
    for axis, (low, high, inner) in enumerate(params["padding_config"]):
        if inner or min(low, high) < 0:
            raise NotImplementedError(f"onnx: expected padding outside only, got {params['padding_config']}")
        shapes = [(*values.shape[:axis], size, *values.shape[axis + 1 :]) for size in (low, high)]
        before, after = (jnp.broadcast_to(filling, shape) for shape in shapes)
        parts = [part for part in (before, values, after) if part.shape[axis]]
        values = lax.concatenate(parts, axis) if len(parts) > 1 else values
    return [values]


def _clamp(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    low, values, high = arguments
    low, high = (jnp.broadcast_to(bound, values.shape) for bound in (low, high))
    return [lax.min(lax.max(values, low), high)]


def _select(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    """Runtimes have no choice between truth values."""
    condition, if_false, if_true = arguments
    if results[0].dtype == bool:
        return [(condition & if_true) | (~condition & if_false)]
    return [lax.select_n(condition, if_false, if_true)]


def _dynamic_slice(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    values, *starts = arguments
    sizes = params["slice_sizes"]
    axes = [axis for axis, size in enumerate(sizes) if size != values.shape[axis]]
    if [sizes[axis] for axis in axes] != [1]:
        raise NotImplementedError(f"onnx: expected one row of {values.shape}, got {sizes}")
    return [jnp.moveaxis(_rows(values, axes, jnp.reshape(starts[axes[0]], (1,))), 0, axes[0])]


def _gather(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    values, indices = arguments
    numbers, (result,) = params["dimension_numbers"], results
    axes = list(numbers.start_index_map)
    if tuple(sorted(axes)) != numbers.collapsed_slice_dims or indices.ndim != 2:
        raise NotImplementedError(f"onnx: expected entries at a vector of positions, got {numbers}")
    sizes = [values.shape[axis] for axis in axes]
    strides = [math.prod(sizes[i + 1 :]) for i in range(len(sizes))]
    (axis,) = set(range(len(result.shape))) - set(numbers.offset_dims)
    return [jnp.moveaxis(_rows(values, axes, (indices * np.array(strides, np.int32)).sum(axis=-1)), 0, axis)]


def _rows(values: Any, axes: Sequence[int], positions: Any) -> Any:
    """The entries at positions along some axes, counted in the order of their axes: a product with ones and zeros."""
    if values.dtype == bool:
        return _rows(values.astype(jnp.float32), axes, positions) > 0.5
    first = jnp.moveaxis(values, axes, range(len(axes)))
    count, rest = math.prod(first.shape[: len(axes)]), first.shape[len(axes) :]
    is_at = (jnp.asarray(positions)[:, None] == np.arange(count)).astype(values.dtype)
    return jnp.matmul(is_at, first.reshape(count, -1), precision="highest").reshape(len(positions), *rest)


def _scan(arguments: list[Any], params: Mapping[str, Any], results: Sequence[Any]) -> list[Any]:
    body, first = params["jaxpr"], len(arguments) - len(results)
    of_step = [variable.aval.shape for variable in (*body.jaxpr.invars, *body.jaxpr.outvars)]
    if of_step != [value.shape for value in (*map(jnp.asarray, arguments), *results)]:
        raise NotImplementedError("onnx: expected a loop without values for each step")
    carried = arguments[first:]
    for _ in range(params["length"]):
        carried = _run(body.jaxpr, body.consts, [*arguments[:first], *carried])
    return carried


# jax2onnx 0.13 has no stack, tile, unstack and platform_index. It converts the others wrongly, or not at all, where the
# batch size is not known; a loop of many operations, always.
_COMPOSED: dict[str, Callable[[list[Any], Mapping[str, Any], Sequence[Any]], Sequence[Any]]] = {
    "clamp": _clamp,
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    "pad": _pad,
    "platform_index": lambda arguments, params, results: [np.int32(0)],
    "scan": _scan,
    "select_n": _select,
    "stack": _stack,
    "tile": _tile,
    "unstack": _unstack,
}
