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


@pytest.mark.parametrize("count", [2, 3])
def test_stored_values_are_those_of_the_function_in_half_as_many_arrays(count):
    """Pairs become complex numbers, because a kernel of XLA's CPU backend has one result."""

    def parts(x):
        return {"arrays": [x + k for k in range(count)], "number": 2.0}

    def loop(x):
        def step(total, index):
            result = compat.stored(index, parts, total)
            assert result["number"] == 2.0
            return sum(result["arrays"]), None

        return jax.lax.scan(step, x, jnp.arange(3))[0]

    x = jnp.array([0.5, -1.0])
    expected = x
    for _ in range(3):
        expected = sum(parts(expected)["arrays"])
    np.testing.assert_allclose(loop(x), expected)
    gradient = jax.grad(lambda x: jnp.sum(loop(x)))(x)
    np.testing.assert_allclose(gradient, count**3)
    (scan,) = [e for e in jax.make_jaxpr(loop)(x).eqns if e.primitive.name == "scan"]
    (cond,) = [e for e in scan.params["jaxpr"].jaxpr.eqns if e.primitive.name == "cond"]
    assert len(cond.outvars) == (count + 1) // 2
