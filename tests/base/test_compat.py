"""Workarounds for the packages that mimic uses."""

import copy
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hydra.core.config_store import ConfigStore

from mimic.base import compat


def test_lazy_modules_run_once_and_may_be_missing(tmp_path, monkeypatch):
    (tmp_path / "waiting").mkdir()
    (tmp_path / "waiting" / "__init__.py").write_text("raise SystemExit('the parent was imported')")
    (tmp_path / "waiting" / "part.py").write_text("import sys\nsys.modules['runs'].append(__name__)\nvalue = 3")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "runs", [])
    for name in ("waiting.part", "waiting.missing", "missing"):
        compat._import_later(name)
    part = sys.modules.pop("waiting.part")
    assert sys.modules["runs"] == []
    assert part.value == part.value == 3
    assert sys.modules["runs"] == ["waiting.part"] and not {"waiting.missing", "missing"}.intersection(sys.modules)


def test_hydra_shares_the_config_store_and_copies_loaded_configs(monkeypatch):
    monkeypatch.setattr(ConfigStore, "__deepcopy__", None, raising=False)  # to be put back
    compat.share_config_store()
    store = ConfigStore.instance()
    assert copy.deepcopy(store) is store
    monkeypatch.setattr(store, "repo", {})
    store.store(name="tried", node={"list": [1]})
    store.load("tried.yaml").node["list"].append(2)
    assert store.load("tried.yaml").node == {"list": [1]}


@pytest.mark.parametrize(("version", "needed"), [("0.10.2", True), ("0.11.0", False), ("0.12.0.1", False)])
def test_the_cpu_flag_is_for_old_jax_alone(version, needed):
    assert compat.needs_cpu_flag(version) is needed


def test_stored_values_have_the_derivatives_of_what_is_stored():
    def function(x, store):
        ones = [jnp.ones(())] * 3  # without a derivative; two of them are a pair
        return sum(store([jnp.sin(x), x**2, 3 * x, *ones, 2.0]))

    for differentiate in (jax.grad, jax.jacfwd, lambda f: jax.grad(jax.grad(f))):
        stored, plain = (differentiate(lambda x, s=s: function(x, s))(0.3) for s in (compat.stored, lambda x: x))
        np.testing.assert_allclose(stored, plain, rtol=1e-6)


@pytest.mark.parametrize("count", [2, 3, 31])
def test_stored_values_are_computed_in_a_kernel_for_each_thirty(count):
    """Pairs become complex numbers, and a reduction of 15 of these is one kernel of XLA's CPU backend."""

    def results(x):
        root = x + 1
        return {"arrays": [k * jnp.ones(3)[:, None] * root for k in range(count)], "number": 2.0}

    def total(x):
        result = compat.stored(results(x))
        assert result["number"] == 2.0
        return sum(result["arrays"])

    x = jnp.array([0.5, -1.0])
    np.testing.assert_allclose(total(x), sum(results(x)["arrays"]))
    np.testing.assert_allclose(jax.grad(lambda x: jnp.sum(total(x)))(x), 3 * count * (count - 1) / 2)
    (together,) = [e for e in jax.make_jaxpr(total)(x).eqns if e.primitive.name == "custom_jvp_call"]
    reductions = [e for e in together.params["call_jaxpr"].eqns if e.primitive.name == "reduce"]
    assert [len(e.outvars) for e in reductions] == ([15, 1] if count == 31 else [(count + 1) // 2])
