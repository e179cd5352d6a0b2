"""What runs record of plugins, and what is said where these are missing."""

import dataclasses
import json

import pytest

import mimic
from mimic.envs.config import EnvConfig
from mimic.trainers.config import PPOConfig, TrainConfig, TrainerConfig, trainer_config
from mimic.trainers.make import make_trainer
from mimic.trainers.run_config import load_config, save_config
from mimic.trainers.run_plugins import PLUGINS, save_plugins, used_plugins


def write(run_dir, **env):
    config = TrainConfig(mimic.env_config("planar4dof", **env), PPOConfig().resolve("cpu"))
    run_dir.mkdir()
    save_config(run_dir, config)
    save_plugins(run_dir, config)
    return run_dir


def height(env, transition):
    return transition.learner_states.position[-1, 2]


def test_a_run_without_plugins_has_no_record(tmp_path, own_registry):
    assert {path.name for path in write(tmp_path / "run").iterdir()} == {"config.yaml"}


def test_a_missing_plugin_is_one_line(tmp_path, own_registry):
    mimic.register("reward_term", "height", height)
    run_dir = write(tmp_path / "run", reward={"terms": {"height": 0.5}})
    assert json.loads((run_dir / PLUGINS).read_text()) == {"reward_term:height": __name__}
    assert load_config(run_dir).env.reward.terms == {"height": 0.5}
    own_registry._registered["reward_term"].clear()
    message = rf"uses the reward_term 'height' of the plugin '{__name__}', which is not loaded.*--plugin {__name__}"
    with pytest.raises(ValueError, match=message):
        load_config(run_dir)
    (run_dir / PLUGINS).unlink()  # the config alone says it too
    with pytest.raises(ValueError, match="reward.terms: expected one of self_collision, got 'height'"):
        load_config(run_dir)


def test_an_existing_run_needs_no_source_of_demonstrations(tmp_path, own_registry):
    mimic.register("demonstrations", "own", lambda expert, config: None)
    run_dir = write(tmp_path / "run", demonstrations={"source": "own"})
    assert json.loads((run_dir / PLUGINS).read_text()) == {"demonstrations:own": __name__}
    own_registry._registered["demonstrations"].clear()
    assert load_config(run_dir).env.demonstrations.source == "own"


@pytest.mark.parametrize(
    "content", ["[1]", "{", '{"other_kind:x": "module"}', '{"reward_term:x": 3}', '{"reward_term": "module"}']
)
def test_a_damaged_record_is_one_line(tmp_path, own_registry, content):
    run_dir = write(tmp_path / "run")
    (run_dir / PLUGINS).write_text(content)
    with pytest.raises(ValueError, match="cannot be read|uses the reward_term ''"):
        load_config(run_dir)


def test_a_run_directory_imports_no_code(tmp_path, own_registry, monkeypatch):
    """Neither its config nor its record."""
    (tmp_path / "hostile.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    run_dir = write(tmp_path / "run")
    text = (run_dir / "config.yaml").read_text()
    changed = text.replace("correspondence: arc_length", "correspondence: hostile:attack")
    assert changed != text
    (run_dir / "config.yaml").write_text(changed)
    with pytest.raises(ValueError, match="got 'hostile:attack'"):
        load_config(run_dir)
    (run_dir / PLUGINS).write_text('{"correspondence:attack": "hostile"}')
    with pytest.raises(ValueError, match="which is not loaded: install its package, or add --plugin hostile"):
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
    assert used_plugins(config) == {"trainer:own": __name__}
    (tmp_path / "run").mkdir()
    save_config(tmp_path / "run", config)
    assert load_config(tmp_path / "run").trainer == OwnConfig(rate=0.1)
    mimic.register("trainer", "own", EnvConfig, replace=True)
    with pytest.raises(ValueError, match="trainer 'own': expected the attribute config_class"):
        trainer_config("own")
