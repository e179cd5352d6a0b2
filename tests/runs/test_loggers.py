"""Metrics logged to Weights & Biases and MLflow, which are replaced by fakes."""

import csv
import sys
import types

import pytest

import mimic
from mimic.base.config import to_dict
from mimic.runs.loggers import check_loggers, make_loggers
from mimic.trainers import run_training as train
from mimic.trainers.config import PoseMapperConfig, TrainConfig


class FakeWandb(types.ModuleType):
    def __init__(self):
        super().__init__("wandb")
        self.begun, self.rows, self.finished = [], {}, 0

    def init(self, **settings):
        self.begun.append(settings)
        return types.SimpleNamespace(log=self._log, finish=self._finish)

    def _log(self, metrics, step):
        self.rows[step] = metrics

    def _finish(self):
        self.finished += 1


class FakeMlflow(types.ModuleType):
    def __init__(self):
        super().__init__("mlflow")
        self.calls, self.rows = [], {}

    def __getattr__(self, name):
        return lambda *arguments, **settings: self.calls.append((name, arguments, settings))

    def active_run(self):
        return types.SimpleNamespace(info=types.SimpleNamespace(run_id="run-7"))

    def log_metrics(self, metrics, step):
        self.rows[step] = metrics

    def named(self, name):
        return [settings for called, _, settings in self.calls if called == name]


@pytest.fixture
def services(monkeypatch):
    for variable in ("WANDB_PROJECT", "MLFLOW_EXPERIMENT_NAME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://localhost:5000")
    fakes = {"wandb": FakeWandb(), "mlflow": FakeMlflow()}
    for name, fake in fakes.items():
        monkeypatch.setitem(sys.modules, name, fake)
    return fakes["wandb"], fakes["mlflow"]


def short_run(run_dir, logger):
    settings = {"samples": 256, "batch_size": 128, "epochs": 2, "hidden_layers": [8], "held_out_poses": 32}
    trainer = PoseMapperConfig(**settings, evaluations=2, validation_poses=32)
    return TrainConfig(
        mimic.env_config("planar4dof"), trainer, run_dir=str(run_dir), logger=logger, compilation_cache=""
    )


@pytest.mark.slow
def test_loggers_get_the_metrics_of_the_files_of_a_run(tmp_path, services):
    wandb, mlflow = services
    config = short_run(tmp_path / "run", ["local", "wandb", "mlflow"])
    assert train.prepare_training(config, 0.0)() == 0
    with (tmp_path / "run" / "metrics.csv").open() as file:
        rows = {int(row.pop("step")): {key: float(value) for key, value in row.items()} for row in csv.DictReader(file)}
    assert len(rows) == 2 and list((tmp_path / "run" / "tensorboard").iterdir())
    assert wandb.rows == mlflow.rows == rows
    assert wandb.finished == len(mlflow.named("end_run")) == 1
    (begun,) = wandb.begun
    assert begun["project"] == "mimic" and begun["dir"] == str(tmp_path / "run") and begun["id"] == "run"
    assert begun["config"]["env"]["name"] == "planar4dof" and begun["config"]["trainer"]["samples"] == 256
    assert mlflow.named("set_experiment") == [{"experiment_name": "mimic"}]


def test_a_resumed_run_continues_its_mlflow_run(tmp_path, services):
    _, mlflow = services
    for _ in range(2):
        for logger in make_loggers(["mlflow", "mlflow"], tmp_path, to_dict(short_run(tmp_path, "mlflow"))):
            logger.write(1, {"gap": 0.5, "diverged": float("nan")})
            logger.close()
    assert [settings["run_id"] for settings in mlflow.named("start_run")] == [None, "run-7"]
    assert mlflow.rows == {1: {"gap": 0.5}}


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_logger_without_its_package_is_rejected(monkeypatch, name):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        ValueError, match=rf"logger={name} needs the package {name}: pip install 'mimic-arms\[{name}\]'"
    ):
        check_loggers(["local", name])


def test_an_unknown_logger_is_rejected(tmp_path):
    with pytest.raises(ValueError, match="logger: expected one of local, wandb, mlflow, got 'comet'"):
        short_run(tmp_path, ["local", "comet"])


def test_mlflow_needs_a_tracking_uri(rejected, services, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    message = rejected("train", "env=planar4dof", "logger=mlflow")
    assert "expected MLFLOW_TRACKING_URI in the environment" in message
