"""Makes the trained networks that come with mimic from run directories, and measures them.

    python -m mimic.train env=panda4dof env.physics=fused run_dir=runs/pretrained/panda4dof-ppo
    python -m benchmarks.pretrained --runs runs/pretrained/* --out mimic/trainers/pretrained/networks \\
        [--half] [--commit HASH]

Each run directory becomes the folder ENV-KIND; one that exists is replaced, others stay. Every number of its report is
that of the stored weights; `copying_distance` is that of copying the angles of joints with the same name. `--half`
stores matrices as float16. The commit is the one that the runs were trained at; default: that of this checkout.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.common.parser import make_parser
from mimic.base.config import flatten, to_dict
from mimic.base.files import read_json
from mimic.envs import env_config
from mimic.metric.kinematics import link_state_table
from mimic.retargeting.pose import shared_joints
from mimic.retargeting.pose_baselines import copy_joints
from mimic.runs.checkpoints import load_checkpoint
from mimic.runs.files import REPORT
from mimic.trainers.config import BUILT_IN_TRAINERS as CONFIGS
from mimic.trainers.config import TrainConfig
from mimic.trainers.make import make_trainer
from mimic.trainers.pose_mapper.trainer import PoseMapperTrainer
from mimic.trainers.pretrained.files import SOURCE, write_network
from mimic.trainers.pretrained.network import TRAINERS
from mimic.trainers.run_config import load_config
from mimic.trainers.trainer import Trainer

MATRICES = {False: "float32", True: "float16"}
_NOT_TRAINED = {"run_dir", "resume", "init", "compilation_cache", "env.name", "trainer.name"}


def make_network(run_dir: Path, out: Path, commit: str, half: bool) -> Path:
    """Writes the folder of a run's network, and returns its path."""
    config = load_config(run_dir)
    kind = next(kind for kind, trainer in TRAINERS.items() if trainer == config.trainer.name)
    if config.env.kind == "sampled_arms":
        raise ValueError(f"{str(run_dir)!r}: expected a network of one learner, got one of many arms")
    trainer = make_trainer(config, run_dir)
    _, params = load_checkpoint(run_dir, trainer.params_template())
    rounded = jax.tree.map(np.asarray, _rounded(params) if half else params)
    outcome = trainer.evaluate(rounded)
    report = {
        **read_json(run_dir / REPORT),
        **trainer.metrics(outcome),
        **trainer.details(outcome),
        "copying_distance": copying_distance(trainer),
        SOURCE: {"command": training_command(config), "commit": commit, "matrices": MATRICES[half]},
    }
    folder = out / f"{config.env.name}-{kind}"
    stored = rounded[:2] if kind == "policy" else rounded  # without the value network
    write_network(folder, config, stored, report, half=half)
    return folder


def training_command(config: TrainConfig) -> str:
    """The shortest command that trains with this config, as far as it differs from the defaults."""
    trainer = CONFIGS[config.trainer.name](preset=config.trainer.preset)
    env = env_config(config.env.name)
    default = TrainConfig(env, trainer).resolve()
    values, defaults = flatten(to_dict(config)), flatten(to_dict(default))
    changed = {key: value for key, value in values.items() if value != defaults.get(key) and key not in _NOT_TRAINED}
    shown = {"env": config.env.name, "trainer": config.trainer.name, "trainer.preset": config.trainer.preset, **changed}
    return "python -m mimic.train " + " ".join(f"{key}={_text(value)}" for key, value in shown.items())


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _rounded(params: Any) -> Any:
    """The parameters as they are read back from float16."""
    return jax.tree.map(lambda x: np.asarray(x, np.float16).astype(x.dtype) if np.ndim(x) > 1 else x, params)


def copying_distance(trainer: Trainer) -> dict[str, float] | None:
    """Mean distance by split of a learner that copies the expert's joints: angles, and velocities for a policy."""
    if isinstance(trainer, PoseMapperTrainer):
        return trainer.copying_distance()
    from mimic.trainers.ppo.trainer import PPOTrainer  # after `make_trainer`, which imports MJX without its messages

    assert isinstance(trainer, PPOTrainer)
    env = trainer.evaluator.env
    steps = env.config.horizon
    qpos, qvel = (np.asarray(x[:, 1 : steps + 1]) for x in (env.demonstrations.qpos, env.demonstrations.qvel))
    copied = copy_joints(env.expert, env.learner, qpos)
    if copied is None:
        return None
    states = link_state_table(env.learner, copied, shared_joints(env.expert, env.learner, qvel))
    expert = jax.tree.map(lambda x: np.asarray(x)[:, 1 : steps + 1], env.expert_states)
    distance = np.asarray(jax.jit(jax.vmap(jax.vmap(env.states_distance)))(expert, states))
    return {split: float(distance[part].mean()) for split, part in trainer.evaluator.parts.items()}


def main() -> None:
    options = make_parser("pretrained", __doc__, out="DIR", runs=[Path()], half=False).parse_args()
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    commit = options.commit or head
    if not commit:
        sys.exit("error: --commit: this is no git checkout; expected the commit that the runs were trained at")
    for run_dir in options.runs:
        try:
            print(f"results: {make_network(run_dir, options.out, commit, options.half)}")
        except ValueError as error:
            sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
