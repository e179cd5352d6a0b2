"""`python -m mimic.inspect RUN/divergence.npz`: what a training that diverged has recorded, and its replay."""

import re
import shutil
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from mimic import inspect
from mimic.commands import cli
from mimic.runs.checkpoints import load_training
from mimic.runs.divergence import FILE, Diverged
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.ppo import training
from mimic.trainers.ppo.divergence import Epoch, find_bad_batch, load_divergence, record_divergence
from mimic.trainers.ppo.trainer import PPOTrainer
from mimic.trainers.run_config import save_config
from tests.helpers.untrained_run import environment

BATCHES = 3  # of an epoch
UPDATES = 8  # of a batch
LAST_UPDATE = (
    BATCHES * UPDATES + UPDATES + 5
)  # with a learning rate of 1e20: the sixth of the second epoch's second batch
SETTINGS = {
    "num_envs": 8, "unroll_length": 5, "batch_size": 4, "num_minibatches": 4, "num_updates_per_batch": 2,
    "hidden_layers": [8], "num_timesteps": 2 * BATCHES * 80, "evaluations": 2,
}  # fmt: skip

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def diverged(tmp_path_factory):
    """A run whose learning rate is 1e20 at one update of its second epoch: its directory and its trainer."""

    def learning_rate(settings, progress):
        return lambda count: jnp.where(count == LAST_UPDATE, 1e20, settings.learning_rate)

    run_dir = tmp_path_factory.mktemp("runs") / "diverged"
    run_dir.mkdir()
    config = TrainConfig(environment(), PPOConfig(**SETTINGS, preset="cpu"), compilation_cache="")
    trainer = PPOTrainer(config, None)
    trainer.save_inputs(run_dir)
    save_config(run_dir, config)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "_learning_rate", learning_rate)
        patch.setattr(trainer, "prepare_evaluation", lambda: None)
        with pytest.raises(Diverged) as error:
            trainer.train(run_dir, lambda *_: False, Signals(), None)
        assert error.value.file == run_dir / FILE
        yield run_dir, trainer


def test_the_first_bad_batch_is_found(diverged):
    """The update after the one with the huge rate has a value loss beyond float32."""
    run_dir, trainer = diverged
    steps = BATCHES * trainer.settings.steps_per_batch
    loaded = load_divergence(run_dir / FILE)
    assert (loaded.env_steps, loaded.batch, loaded.batches, loaded.devices) == (steps, 2, BATCHES, 1)
    assert str(loaded.finding) == "value loss in update 7 of 8" and loaded.num_bad_arms == 0
    assert np.isfinite(loaded.metrics[:6]).all()
    checkpoint = load_training(run_dir, trainer.params_template())
    assert checkpoint.step == steps and checkpoint.state is not None
    bad = find_bad_batch(trainer.replay(), Epoch(steps, BATCHES, checkpoint.state))
    assert bad is not None and bad.batch == 2
    for leaf, expected in zip(bad.state, loaded.state, strict=True):
        np.testing.assert_array_equal(leaf, expected)


def test_finite_batches_are_no_divergence(diverged, tmp_path, capsys):
    run_dir, trainer = diverged
    leaves = load_training(run_dir, trainer.params_template()).state
    assert leaves is not None
    epoch = Epoch(0, 1, leaves)
    assert record_divergence(tmp_path, trainer.replay, epoch) is None
    assert capsys.readouterr().out.endswith("all batches are finite when they run one at a time\n")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def shown(diverged, monkeypatch, capsys):
    """A function that replays a file and returns the output."""

    def run(file):
        monkeypatch.setattr(sys, "argv", ["mimic.inspect", str(file)])
        cli.run(inspect.prepare, "inspect")
        return capsys.readouterr().out

    return run


def test_a_replay_reproduces_the_divergence(diverged, shown):
    run_dir, trainer = diverged
    output = shown(run_dir / FILE)
    steps = (BATCHES + 1) * trainer.settings.steps_per_batch
    assert output.startswith(
        "first not finite: value loss in update 7 of 8\n"
        f"in batch 2 of 3 of a training epoch, after {steps} steps\n"
        "replay on cpu: reproduces it, with the same metrics to the bit\n"
        "training metrics of update 7 of 8"
    )
    (values,) = re.findall(r"│ loss +│ +(\S+) │ +(\S+) │ +(\S+) │", output)
    before, recorded, replayed = map(float, values)
    assert np.isfinite(before) and not np.isfinite(recorded) and not np.isfinite(replayed)
    assert re.search(r"qvel \[rad/s\] │ +\d\S* │", output) and re.search(r"learning_rate +│ +0.001 │", output)


def test_a_replay_that_is_finite_says_so(diverged, shown, monkeypatch):
    monkeypatch.setattr(training, "_learning_rate", lambda settings, progress: lambda count: settings.learning_rate)
    assert "replay on cpu: does not reproduce it, all is finite\n" in shown(diverged[0] / FILE)


def test_files_without_their_run_are_rejected(diverged, tmp_path, rejected):
    file = shutil.copy(diverged[0] / FILE, tmp_path)
    assert f"expected a file in its run directory; '{tmp_path}' has no config.yaml" in rejected("inspect", file)


@pytest.mark.parametrize(
    ("change", "arguments", "message"),
    [
        (lambda run: (run / "checkpoints" / "run_id").write_text("another"), [], "is of another run than"),
        (lambda run: (run / FILE).write_bytes(b"PK"), [], "is no file of a training that diverged: it is no zip"),
        (lambda run: (run / FILE).unlink(), [], "No such file"),
        (lambda run: None, ["bound=false"], "expected no other keys"),
    ],
)
def test_bad_input_of_a_replay(diverged, tmp_path, rejected, change, arguments, message):
    run_dir = shutil.copytree(diverged[0], tmp_path / "run")
    change(run_dir)
    assert message in rejected("inspect", run_dir / FILE, *arguments)


def test_a_file_of_another_network_is_rejected(diverged, tmp_path, rejected):
    run_dir = shutil.copytree(diverged[0], tmp_path / "run")
    config = (run_dir / "config.yaml").read_text()
    (run_dir / "config.yaml").write_text(re.sub(r"hidden_layers:\n  - 8\n", "hidden_layers:\n  - 9\n", config))
    assert "it has other arms or another network" in rejected("inspect", run_dir / FILE)
