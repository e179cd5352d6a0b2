"""6. Train a policy, read its report, and watch it.

    python examples/06_train_and_evaluate.py [FOLDER]

A small training that still learns: planar arms with seven and four links.
"""

import csv
import json
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np

import mimic

out = Path(sys.argv[1] if len(sys.argv) > 1 else time.strftime("examples_out/06_train_and_evaluate-%Y%m%d-%H%M%S"))
out.mkdir(parents=True, exist_ok=True)


def command(name, *arguments):
    """Prints the shell command `python -m mimic.NAME ...` and runs it."""
    print(f"\n$ python -m mimic.{name} {' '.join(arguments)}", flush=True)
    subprocess.run([sys.executable, "-m", f"mimic.{name}", *arguments], check=True)


# ---- The environment -------------------------------------------------------------------------------------------------
#
# The learner is driven by torques, each held for 0.1 s. It observes its own link states, the expert's, and the expert's
# 0.1 s later, but not the expert's controls. The reward is minus the embodiment distance after the step. `mimic.make`
# returns an environment of brax:

env = mimic.make("planar4dof", demonstrations={"count": 2, "held_out": 1})
print(f"{env.observation_size} observations; {env.action_size} actions in [-1, 1], scaled by", env.torque_scale, "N m")
state = jax.jit(env.reset)(jax.random.key(0))
state = jax.jit(env.step)(state, np.zeros(env.action_size, np.float32))
print(f"reward of the first step, without any torque: {float(state.reward):.4f}")

# ---- Training --------------------------------------------------------------------------------------------------------
#
# PPO with 256 arms in parallel. This is short: about 180,000 steps and 16 demonstrations. The defaults are 124
# demonstrations, and 2 million steps on CPUs or 150 million on a GPU. `python -m mimic.train --help` lists all keys.

run = out / "run"
command(
    "train", "env=planar4dof", "env.demonstrations.count=16", "env.demonstrations.held_out=4",
    "trainer.preset=cpu", "trainer.num_envs=256", "trainer.num_minibatches=16", "trainer.num_timesteps=180000",
    "trainer.evaluations=3", f"run_dir={run}",
)  # fmt: skip

# ---- The report ------------------------------------------------------------------------------------------------------
#
# The optimality gap measures quality: 0 is the kinematic bound, the minimum that the learner's joints allow at each
# moment, and 1 is holding the start pose. The gap on training demonstrations is far smaller than on held-out ones,
# since 16 demonstrations are few. The held-out gap is the one to judge a policy by.

report = json.loads((run / "report.json").read_text())
gap, distance = report["optimality_gap"], report["mean_distance"]
print(f"\ngap: {gap['train']:.1%} on training demonstrations, {gap['held_out']:.1%} on held-out ones")
print(f"mean distance: {distance['held_out']:.4f}, between its bound {report['lower_bound']['held_out']:.4f} "
      f"and holding the start pose {report['hold_distance']['held_out']:.4f}")  # fmt: skip
with (run / "metrics.csv").open(newline="") as file:
    for row in csv.DictReader(file):
        print(f"  training gap after {int(row['step']):7,} steps: {float(row['quality/optimality_gap.train']):.1%}")

# ---- From the checkpoint alone ---------------------------------------------------------------------------------------
#
# `mimic.evaluate` needs only the run directory. It reproduces the report, and evaluates other controllers on the same
# demonstrations: `pd` tracks the optimal poses without knowing the dynamics, `computed_torque` knows them exactly and
# is hard to beat. See docs/dynamic_imitation.md.

command("evaluate", f"run={run}", f"out={out / 'same'}")
command("evaluate", f"run={run}", f"out={out / 'pd'}", "controller=pd")
same, pd = (json.loads((out / name / "report.json").read_text())["optimality_gap"] for name in ("same", "pd"))
print(f"\nheld-out gap: {gap['held_out']:.2%} after training, {same['held_out']:.2%} from the checkpoint, "
      f"{pd['held_out']:.2%} of PD control")  # fmt: skip

# ---- A video ---------------------------------------------------------------------------------------------------------

command("render", f"run={run}", "demonstration=0", f"out={out / 'policy.mp4'}")
print(f"\nresults: {out}")
