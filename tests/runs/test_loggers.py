"""Metrics logged to Weights & Biases, which is replaced by a fake."""

import sys
import types

import pytest

import mimic
from mimic.trainers import run_training as train
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from tests.helpers.run_directories import rows_of


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


def short_run(run_dir, logger):
    settings = {"samples": 256, "batch_size": 128, "epochs": 2, "hidden_layers": [8], "held_out_poses": 32}
    trainer = PoseMapperConfig(**settings, evaluations=2, validation_poses=32)
    return TrainConfig(
        mimic.env_config("planar4dof"), trainer, run_dir=str(run_dir), logger=logger, compilation_cache=""
    )


@pytest.mark.slow
def test_the_logger_gets_the_metrics_of_the_files_of_a_run(tmp_path, monkeypatch):
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    monkeypatch.setitem(sys.modules, "wandb", wandb := FakeWandb())
    assert train.prepare_training(short_run(tmp_path / "run", "wandb"), 0.0)() == 0
    written = rows_of(tmp_path / "run")
    rows = {int(row.pop("step")): {key: float(value) for key, value in row.items()} for row in written}
    assert len(rows) == 2 and list((tmp_path / "run" / "tensorboard").iterdir())
    assert wandb.rows == rows and wandb.finished == 1
    (begun,) = wandb.begun
    assert begun["project"] == "mimic" and begun["dir"] == str(tmp_path / "run") and begun["id"] == "run"
    assert begun["config"]["env"]["name"] == "planar4dof" and begun["config"]["trainer"]["samples"] == 256


def test_a_logger_without_its_package_is_rejected(reason, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    message = reason("train", "env=planar4dof", "logger=wandb")
    assert "logger=wandb needs the package wandb: pip install 'mimic-arms[wandb]'" in message


def test_an_unknown_logger_is_rejected(tmp_path):
    with pytest.raises(ValueError, match="logger: expected one of local, wandb, got 'comet'"):
        short_run(tmp_path, "comet")
