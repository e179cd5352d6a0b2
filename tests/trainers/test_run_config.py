"""Configs of runs that use what plugins register: missing plugins are one line, and nothing is imported."""

import dataclasses

import pytest

import mimic
from mimic.envs.config import EnvConfig
from mimic.trainers.config import PPOConfig, TrainConfig, TrainerConfig, trainer_config
from mimic.trainers.make import make_trainer
from mimic.trainers.run_config import load_config, save_config


def write(run_dir, trainer=None, **env):
    run_dir.mkdir()
    save_config(run_dir, TrainConfig(mimic.env_config("planar4dof", **env), trainer or PPOConfig().resolve("cpu")))
    return run_dir


def height(env, transition):
    return transition.learner_states.position[-1, 2]


class Own(mimic.ImitationEnv):
    preset = {"learner": "planar"}


@pytest.mark.parametrize(
    ("kind", "thing", "settings"),
    [("reward_term", height, {"reward": {"terms": {"own": 0.5}}}), ("environment", Own, {"environment": "own"})],
)
def test_a_missing_plugin_is_one_line(tmp_path, own_registry, kind, thing, settings):
    mimic.register(kind, "own", thing)
    run_dir = write(tmp_path / "run", **settings)
    assert load_config(run_dir).env == mimic.env_config("planar4dof", **settings)
    own_registry._registered[kind].clear()
    with pytest.raises(ValueError, match=r"config.yaml' cannot be read: .*got 'own'; .* by --plugin MODULE") as error:
        load_config(run_dir)
    assert "\n" not in str(error.value)


def test_an_existing_run_needs_no_source_of_demonstrations(tmp_path, own_registry):
    mimic.register("demonstrations", "own", lambda expert, config: None)
    run_dir = write(tmp_path / "run", demonstrations={"source": "own"})
    own_registry._registered["demonstrations"].clear()
    assert load_config(run_dir).env.demonstrations.source == "own"


def test_a_run_directory_imports_no_code(tmp_path, own_registry, monkeypatch):
    (tmp_path / "hostile.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    run_dir = write(tmp_path / "run")
    text = (run_dir / "config.yaml").read_text()
    changed = text.replace("correspondence: arc_length", "correspondence: hostile:attack")
    assert changed != text
    (run_dir / "config.yaml").write_text(changed)
    with pytest.raises(ValueError, match="got 'hostile:attack'"):
        load_config(run_dir)


@dataclasses.dataclass(frozen=True)
class OwnConfig(TrainerConfig):
    name: str = "own"
    preset: str = "none"
    rate: float = 0.5


class OwnTrainer:
    config_class = OwnConfig

    def __init__(self, config, run_dir):
        self.config = config


def test_a_registered_trainer_is_made_from_its_config(own_registry, tmp_path):
    mimic.register("trainer", "own", OwnTrainer)
    config = TrainConfig(mimic.env_config("planar4dof"), OwnConfig(rate=0.1), run_dir=str(tmp_path / "run"))
    assert isinstance(make_trainer(config, None), OwnTrainer)
    assert load_config(write(tmp_path / "run", config.trainer)).trainer == OwnConfig(rate=0.1)
    mimic.register("trainer", "own", EnvConfig, replace=True)
    with pytest.raises(ValueError, match="trainer 'own': expected the attribute config_class"):
        trainer_config("own")
