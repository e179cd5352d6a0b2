"""`python -m mimic.evaluate` of a run of many arms: one of them alone, and what it and other commands reject."""

import json

import numpy as np
import pytest

from mimic.commands.clips import prepare_clip
from mimic.commands.config import EvaluateConfig, RenderConfig
from mimic.commands.evaluate import prepare_evaluation
from mimic.runs.checkpoints import save_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.run_config import save_config
from tests.helpers.run_directories import write_run
from tests.helpers.untrained_run import FAMILY, family, untrained_run


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return untrained_run(tmp_path_factory.mktemp("runs") / "run", family())


@pytest.fixture(scope="module")
def config_alone(tmp_path_factory):
    """A run without networks: what it is rejected for is known from its config."""
    folder = tmp_path_factory.mktemp("runs") / "config"
    folder.mkdir()
    save_config(folder, TrainConfig(family(), PPOConfig(preset="any_arm").resolve()))
    save_checkpoint(folder, 1, {"weight": np.zeros(1, np.float32)})
    return folder


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ["controller=pd"],
            "controller: expected policy or nearest_pose for all arms of a run of many, got pd; choose",
        ),
        (["locked=[2]"], "locked: expected with learner=NAME, as in learner=panda locked=[2,4], got [2]"),
        (["learner=panda_pair"], "panda_pair: expected a serial arm, got a tree of 2 chains"),
    ],
)
def test_what_many_arms_do_not_have_is_rejected(config_alone, reason, settings, message):
    assert message in reason("evaluate", f"run={config_alone}", *settings)


def test_a_run_of_one_learner_has_its_own(reason, tmp_path):
    run_dir = write_run(tmp_path / "one", [0.1])
    save_checkpoint(run_dir, 1, {"weight": np.zeros(1, np.float32)})
    assert "learner: expected a run of many arms, got one of env=planar4dof" in reason(
        "evaluate", f"run={run_dir}", "learner=panda"
    )


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("view", "expected an environment of one learner, got"),
        ("render", "learner: expected one arm for a run of many, env=panda_family, as in learner=panda locked=[2,4]"),
    ],
)
def test_what_shows_one_arm_rejects_many(config_alone, reason, command, message):
    assert message in reason(command, f"run={config_alone}")


@pytest.mark.slow
def test_one_arm_has_the_report_of_a_run_of_one_learner(run_dir, tmp_path):
    """The controller without learning first: its gap is small, whereas that of initial parameters may be any."""
    out = tmp_path / "out"
    options = {"learner": "panda", "locked": [2], "compilation_cache": ""}
    prepare_evaluation(EvaluateConfig(str(run_dir), controller="nearest_pose", **options), 0.0)()
    prepare_evaluation(EvaluateConfig(str(run_dir), out=str(out), **options), 0.0)()
    report = json.loads((out / "report.json").read_text())
    assert report["env"] == "panda_family-panda-locked-2" and report["physics"] == "fused"
    assert report["evaluated"]["learner"] == "panda" and report["evaluated"]["locked"] == [2]
    assert report["mjx"]["mean_distance"] == pytest.approx(report["mean_distance"], rel=1e-3)
    assert len((out / "demonstrations.csv").read_text().splitlines()) == 1 + sum(FAMILY["demonstrations"].values())
    prepare_evaluation(EvaluateConfig(str(run_dir), controller="hold", **options), 0.0)()


@pytest.mark.slow
def test_a_video_shows_the_policy_on_one_arm(run_dir):
    plan = prepare_clip(RenderConfig(str(run_dir), learner="panda", locked=[2], compilation_cache=""))
    clip = plan.compute()
    assert plan.out == run_dir / "videos" / "panda_family-panda-locked-2-held_out-0.mp4"
    assert [poses.shape[1] for poses in clip.poses] == [7, 6]
    bound, policy = (next(c.values for c in clip.curves if c.label == key) for key in ("kinematic bound", "policy"))
    assert len(policy) == FAMILY["horizon"] and np.all(bound <= policy + 1e-6)
