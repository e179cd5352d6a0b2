"""Registration of things of packages and notebooks, and what configs may import."""

import importlib.metadata
import os
import re
import sys

import pytest

import mimic
from mimic.base.config import typed
from mimic.commands.arguments import load_plugins
from mimic.metric.config import MetricConfig

pytestmark = pytest.mark.usefixtures("own_registry")


def double(expert, learner):
    return 2 * mimic.arc_length_correspondence(expert, learner)


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module `own_terms` in the current folder, which notes that it was imported."""
    text = (
        "import mimic, sys\nsys.modules['imports'].append(1)\nmimic.register('correspondence', 'own', lambda e, l: 0)\n"
    )
    (tmp_path / "own_terms.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "imports", imports := [])  # type: ignore[arg-type]
    yield imports
    sys.modules.pop("own_terms", None)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("corespondence", "x", double), "kind: expected one of correspondence, demonstrations, environment"),
        (("correspondence", "two words", double), "expected a name of letters"),
        (("correspondence", "a:b", double), "expected a name of letters"),
        (("correspondence", "overlap", double), "'overlap' is built in"),
        (("environment", "panda4dof", {}), "'panda4dof' is built in"),
        (("trainer", "ppo", double), "'ppo' is built in"),
        (("correspondence", "x", [[1.0]]), r"expected a function \(expert, learner\)"),
    ],
)
def test_what_cannot_be_registered(arguments, message):
    import mimic.trainers.config  # noqa: F401 - reserves the names of trainers

    with pytest.raises(ValueError, match=message):
        mimic.register(*arguments)


def test_a_name_is_registered_once_unless_replaced():
    assert mimic.register("correspondence", "double")(double) is double
    with pytest.raises(ValueError, match=r"registered already, by .*test_registry; replace=True"):
        mimic.register("correspondence", "double", double)
    mimic.register("correspondence", "double", len, replace=True)
    with pytest.raises(ValueError, match=r"arc_length, overlap, hard, soft, double, got 'triple'"):
        MetricConfig(correspondence="triple")


def test_a_package_registers_by_its_entry_point(own_registry, monkeypatch, capsys):
    monkeypatch.setattr(own_registry, "_is_loaded", False)
    calls = []

    class Entry:
        name, dist, module = "arms", None, "package_of_arms"

        def load(self):
            calls.append(1)
            return lambda: mimic.register("correspondence", "double", double)

    class Broken(Entry):
        name, module = "broken", "broken_package"

        def load(self):
            raise ImportError("no\nsuch thing")

    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: {"mimic.plugins": [Broken(), Entry()]}[group])
    for _ in range(2):
        assert MetricConfig(correspondence="double").correspondence == "double"
    assert calls == [1] and own_registry._registered["correspondence"]["double"].origin == "package_of_arms"
    assert capsys.readouterr().err == "warning: plugin 'broken' of broken_package failed: ImportError: no such thing\n"


def test_a_config_imports_nothing(module):
    with pytest.raises(ValueError, match="correspondence: expected one of arc_length, .*, got 'own_terms:matrix'"):
        MetricConfig(correspondence="own_terms:matrix")
    assert module == []


def test_a_plugin_is_imported_and_named_for_other_processes(module, own_registry):
    assert load_plugins(["--plugin", "own_terms", "seed=1"]) == ["seed=1"]
    assert own_registry.names("correspondence") == ("own",) and module == [1]
    assert own_registry._registered["correspondence"]["own"].origin == "own_terms"
    assert os.environ[own_registry.VARIABLE] == "own_terms"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--plugin"], "--plugin: expected a module"),
        (["--plugin", "no_such_module"], "--plugin no_such_module failed: ModuleNotFoundError"),
        (["env=no_such_env"], "unknown env 'no_such_env'; valid are any_arm, bimanual, pair, panda3dof"),
        (["trainer=no_such_trainer"], "unknown trainer 'no_such_trainer'; valid are brax, pose_mapper, ppo"),
    ],
)
def test_a_bad_name_is_one_line(rejected, arguments, message):
    assert re.search(message, rejected("train", *arguments))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"observation": {"terms": ["x"]}}, "observation.terms: expected one of none, got 'x'"),
        ({"reward": {"terms": {"x": 1}}}, "reward.terms: expected one of self_collision, got 'x'"),
        ({"metric": {"link_distance": "x"}}, "link_distance: expected one of none, got 'x'"),
        ({"demonstrations": {"source": "x"}}, "demonstrations.source: expected one of none, got 'x'"),
    ],
)
def test_an_unknown_name_lists_the_valid_ones(overrides, message):
    with pytest.raises(ValueError, match=message):
        mimic.make("planar4dof", **overrides)


def test_a_registered_environment_is_a_preset():
    preset = {"expert": {"link_lengths": [0.5, 0.5], "model": "planar"}, "learner": "panda", "horizon": 7}
    mimic.register("environment", "short", preset)
    assert mimic.environments()[-1] == "short"
    config = mimic.env_config("short", preview=0)
    assert (config.name, config.horizon, config.preview, config.learner.model) == ("short", 7, 0, "panda")
    with pytest.raises(ValueError, match="unknown environment 'long'; valid are .*planar7dof, short"):
        mimic.env_config("long")


def test_a_registered_environment_is_composed(monkeypatch):
    from hydra import compose, initialize_config_module
    from hydra.core.config_store import ConfigStore

    from mimic.commands import cli

    mimic.register("environment", "short", {"horizon": 7, "learner": "panda"})
    store = ConfigStore.instance()
    monkeypatch.setattr(store, "repo", dict(store.repo))
    cli._register_schemas()
    with initialize_config_module("mimic.conf", version_base="1.3"):
        config = typed(compose("train", ["env=short", "env.horizon=8"]))
    assert (config.env.name, config.env.horizon, config.env.learner.model) == ("short", 8, "panda")
