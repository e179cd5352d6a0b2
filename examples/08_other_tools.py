"""8. With other tools: Gymnasium and ONNX Runtime.

    python examples/08_other_tools.py [FOLDER]

Needs two extras and ONNX Runtime: pip install -c constraints.txt -e '.[export,gymnasium]' onnxruntime
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import onnxruntime

import mimic
import mimic.gymnasium  # registers the environments

out = Path(sys.argv[1] if len(sys.argv) > 1 else time.strftime("examples_out/08_other_tools-%Y%m%d-%H%M%S"))
out.mkdir(parents=True, exist_ok=True)

# ---- A policy --------------------------------------------------------------------------------------------------------
#
# A policy to export. It is trained for seconds, which is too short for good results; example 6 trains a better one.

run = out / "run"
arguments = [
    "env=planar4dof", "env.demonstrations.count=8", "env.demonstrations.held_out=2",
    "trainer.preset=cpu", "trainer.num_envs=128", "trainer.batch_size=64", "trainer.num_minibatches=16",
    "trainer.hidden_layers=[32,32]", "trainer.num_timesteps=80000", "trainer.evaluations=1", f"run_dir={run}",
]  # fmt: skip
print(f"$ python -m mimic.train {' '.join(arguments)}", flush=True)
subprocess.run([sys.executable, "-m", "mimic.train", *arguments], check=True)

# ---- A file that needs neither mimic nor JAX -------------------------------------------------------------------------
#
# The ONNX file contains the whole policy, with the normalisation of observations. Its metadata name every input and
# output.

policy = mimic.export_run(run, out / "policy.onnx")  # or python -m mimic.export run=DIR out=FILE
session = onnxruntime.InferenceSession(str(policy), providers=["CPUExecutionProvider"])
metadata = session.get_modelmeta().custom_metadata_map
joints = ", ".join(json.loads(metadata["learner_joints"]))
print(f"\n{policy.name}: {policy.stat().st_size / 1024:.0f} KiB, for the joints {joints}")
for part in json.loads(metadata["observation_layout"]):
    print(f"  observation[{part['start']}:{part['stop']}]  {part['name']}")

# ---- Many arms as a Gymnasium environment ----------------------------------------------------------------------------
#
# Inputs and outputs are NumPy arrays; one compiled function steps all arms in parallel. An episode ends after 5 s or
# with a runaway, and the same step starts the next episode. The return of an episode is the sum of its rewards, which
# are minus the distances.

demonstrations = {"path": str(run / "demonstrations.npz"), "count": 8, "held_out": 2}
arms = gymnasium.make_vec("mimic/planar4dof-v0", num_envs=64, demonstrations=demonstrations)
limit = np.array(json.loads(metadata["torque_scale"]))  # N m, the torque of an action of 1


def episode(act):
    """Mean sum of rewards over an episode of 50 steps, and arm steps per second."""
    observations, _ = arms.reset(seed=0)
    total, began = np.zeros(arms.num_envs), time.perf_counter()
    running = np.ones(arms.num_envs, bool)
    for _ in range(50):
        observations, rewards, ended, _, _ = arms.step(act(observations))
        total += rewards * running
        running &= ~ended
    return total.mean(), 50 * arms.num_envs / (time.perf_counter() - began)


def onnx_policy(observations):
    action, torque = session.run(["action", "torque"], {"observation": observations})
    np.testing.assert_allclose(torque, action * limit, rtol=1e-4, atol=1e-4)  # N m
    return action


arms.action_space.seed(0)
controllers = {
    "no torque": lambda observations: np.zeros((arms.num_envs, 4), np.float32),
    "random torques": lambda observations: arms.action_space.sample(),
    "the policy, by ONNX Runtime": onnx_policy,
}
episode(controllers["no torque"])  # compiles
print(f"\nreturn of an episode, mean of {arms.num_envs} arms (0 is a perfect match throughout)")
for name, act in controllers.items():
    reward, rate = episode(act)
    print(f"  {name:28} {reward:8.2f}    {rate:9,.0f} steps/s")
arms.close()

# ---- Is it the same policy? ------------------------------------------------------------------------------------------
#
# The report of the training, computed by JAX, and the exported policy in Gymnasium should agree on the mean distance of
# the training demonstrations. The arms above follow random demonstrations, so here one arm follows each in turn.

arm = gymnasium.make("mimic/planar4dof-v0", demonstrations=demonstrations)
distances = []
for index in range(8):
    observation, _ = arm.reset(seed=0, options={"demonstration": index})
    for _ in range(50):
        observation, reward, _, _, _ = arm.step(onnx_policy(observation[None])[0])
        distances.append(-float(reward))
arm.close()
report = json.loads((run / "report.json").read_text())
print(f"\nmean distance on the training demonstrations: {np.mean(distances):.5f} by Gymnasium and ONNX Runtime, "
      f"{report['mean_distance']['train']:.5f} in the report")  # fmt: skip
print(f"results: {out}")
