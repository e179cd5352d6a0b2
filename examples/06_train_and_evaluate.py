"""6. Train a policy, read its report, and watch it.

    python examples/06_train_and_evaluate.py [FOLDER]

It is the smallest training that shows something: planar arms, of seven and four links.
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
    """Runs `python -m mimic.NAME`, and shows the line that does the same in a shell."""
    print(f"\n$ python -m mimic.{name} {' '.join(arguments)}", flush=True)
    subprocess.run([sys.executable, "-m", f"mimic.{name}", *arguments], check=True)


# ---- The environment -------------------------------------------------------------------------------------------------
#
# The learner is driven by torques, each held for 0.1 s. It sees its own link states, the expert's, and those 0.1 s
# ahead. Its reward is minus the embodiment distance after the step. What it does not see is how the expert is
# controlled. As an environment of brax:

env = mimic.make("planar4dof", physics="fused", demonstrations={"count": 2, "held_out": 1})
print(f"{env.observation_size} observations; {env.action_size} actions in [-1, 1], shares of", env.torque_scale, "N m")
state = jax.jit(env.reset)(jax.random.key(0))
state = jax.jit(env.step)(state, np.zeros(env.action_size, np.float32))
print(f"reward of the first step, without any torque: {float(state.reward):.4f}")

# ---- Training --------------------------------------------------------------------------------------------------------
#
# PPO on 256 arms at once. 184,000 steps are few, and so are 16 demonstrations; the defaults are 3 million steps
# and 124 demonstrations on CPUs, and 150 million steps on a GPU. All keys are in `python -m mimic.train --help`.

run = out / "run"
command(
    "train", "env=planar4dof", "env.physics=fused", "env.demonstrations.count=16", "env.demonstrations.held_out=4",
    "trainer.preset=cpu", "trainer.num_envs=256", "trainer.num_minibatches=16", "trainer.num_timesteps=180000",
    "trainer.evaluations=3", f"run_dir={run}",
)  # fmt: skip

# ---- The report ------------------------------------------------------------------------------------------------------
#
# The optimality gap is the number to look at: 0 is the kinematic bound, the best that the learner's joints allow at
# each moment, and 1 is holding the start pose. On demonstrations that it was trained on the policy does far better than
# on others: sixteen are few to learn from. A gap on held-out ones says more of a policy than the one that it was
# trained for.

report = json.loads((run / "report.json").read_text())
gap, distance = report["optimality_gap"], report["mean_distance"]
print(f"\ngap: {gap['train']:.1%} on training demonstrations, {gap['held_out']:.1%} on held-out ones")
print(f"mean distance: {distance['held_out']:.4f}, between its bound {report['lower_bound']['held_out']:.4f} "
      f"and holding the start pose {report['hold_distance']['held_out']:.4f}")  # fmt: skip
with (run / "metrics.csv").open(newline="") as file:
    for row in csv.DictReader(file):
        print(f"  after {int(row['step']):7,} steps: {float(row['quality/optimality_gap.train']):.1%} on training ones")

# ---- From the checkpoint alone ---------------------------------------------------------------------------------------
#
# `mimic.evaluate` needs nothing but the run directory. It repeats the report to the last digits, and can change what
# the policy has not been trained for: here all of the learner's bodies are 20 % heavier, and the policy is not told.

command("evaluate", f"run={run}", f"out={out / 'same'}")
command("evaluate", f"run={run}", f"out={out / 'heavier'}", "mass=1.2")
same, heavier = (json.loads((out / name / "report.json").read_text())["optimality_gap"] for name in ("same", "heavier"))
print(f"\nheld-out gap: {gap['held_out']:.2%} after training, {same['held_out']:.2%} from the checkpoint, "
      f"{heavier['held_out']:.2%} with 20 % more mass")  # fmt: skip

# Without a policy there are controllers to compare with: `controller=computed_torque` tracks the optimal poses and
# knows the arm's dynamics, which is hard to beat. See docs/dynamic_imitation.md.

# ---- A video ---------------------------------------------------------------------------------------------------------

command("render", f"run={run}", "demonstration=0", f"out={out / 'policy.mp4'}")
print(f"\nresults: {out}")
