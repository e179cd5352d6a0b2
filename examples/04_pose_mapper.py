"""4. A network that answers at once: train a pose mapper, and retarget a whole motion.

    python examples/04_pose_mapper.py [FOLDER]

Trains for some seconds; a mapper trained as `python -m mimic.train trainer=pose_mapper` does by default is far better.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import jax
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

import mimic

out = Path(sys.argv[1] if len(sys.argv) > 1 else time.strftime("examples_out/04_pose_mapper-%Y%m%d-%H%M%S"))
out.mkdir(parents=True, exist_ok=True)


def command(name, *arguments):
    """Runs `python -m mimic.NAME`, and shows the line that does the same in a shell."""
    print(f"\n$ python -m mimic.{name} {' '.join(arguments)}", flush=True)
    subprocess.run([sys.executable, "-m", f"mimic.{name}", *arguments], check=True)


# ---- Training --------------------------------------------------------------------------------------------------------
#
# The network takes a pose of the expert and gives one of the learner. There are no labels: what it learns from is the
# embodiment distance of its answer, differentiated through both arms. It proposes four poses, of which the nearest
# counts (`trainer.heads`), because the best pose jumps as the expert moves on, and one continuous answer cannot.
#
# A training run writes all that belongs to it into one folder. This one is short, and its network is small: three
# epochs of the default's thirty.

mapper_run = out / "mapper"
command(
    "train", "trainer=pose_mapper", "env=panda4dof", "trainer.epochs=3", "trainer.evaluations=3",
    "trainer.hidden_layers=[64,64]", "trainer.held_out_poses=500", f"run_dir={mapper_run}",
)  # fmt: skip
report = json.loads((mapper_run / "report.json").read_text())
print(f"\nquality on unseen poses, 0 for the optimiser and 1 for a random pose: {report['quality']['held_out']:.1%}")

# ---- One pose at a time ----------------------------------------------------------------------------------------------
#
# A mapper is a function of a pose or of any batch of them, and far faster than the optimiser: the searching was done in
# training.

mapper = mimic.PoseMapper.load(mapper_run)
env = mimic.env_config("panda4dof")
expert, learner = mapper.expert, mapper.learner
correspondence, weights = env.metric.make_correspondence(expert, learner), env.metric.make_weights()
poses = np.random.default_rng(0).uniform(-np.pi, np.pi, (2000, 7)).astype(np.float32)


def seconds(function):
    """Of a call, once compiled."""
    jax.block_until_ready(function(poses))
    began = time.perf_counter()
    jax.block_until_ready(function(poses))
    return time.perf_counter() - began


optimise = jax.jit(lambda qpos: mimic.imitate_pose(expert, learner, qpos, correspondence, weights).qpos)
for name, function in (("optimiser", optimise), ("mapper", jax.jit(mapper))):
    print(f"{name:9}  {len(poses) / seconds(function):9,.0f} poses a second")

# ---- A whole motion --------------------------------------------------------------------------------------------------
#
# Neighbouring poses must stay neighbours, and no joint may turn faster than it is rated. `mimic.retarget` sees to both:
# by the optimiser it tracks minima over time, by the mapper it chooses among the heads such that the motion stays near
# and smooth. What comes out are demonstrations of the learner's arm. First, motions of the expert to retarget:

motions = mimic.record_demonstrations(mimic.build_arm(env.expert), 4)
motions.save(out / "expert.npz")
files = {"optimiser": out / "optimised.npz", "mapper": out / "mapped.npz"}
command("retarget", f"demonstrations={out / 'expert.npz'}", "learner=panda4dof", f"out={files['optimiser']}")
command(
    "retarget", f"demonstrations={out / 'expert.npz'}", "learner=panda4dof", f"out={files['mapper']}",
    f"mapper={mapper_run}",
)  # fmt: skip

# ---- How far apart? --------------------------------------------------------------------------------------------------
#
# The same distance for both, at each time; that of a learner which stays in its zero pose is the scale. Two things to
# know: the optimiser's motion is no bound, since a better pose may be out of reach without a jump. And motions begin
# where the learner is most like the expert, not in its zero pose: a robot must get there first.

distance = jax.jit(
    jax.vmap(
        jax.vmap(
            lambda qpos, learner_qpos: mimic.embodiment_distance(
                mimic.link_states(expert, qpos), mimic.link_states(learner, learner_qpos), correspondence, weights
            )
        )
    )
)
retargeted = {name: mimic.load_demonstrations(file).qpos for name, file in files.items()}
retargeted["zero pose"] = np.zeros_like(retargeted["mapper"])
figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
seconds_of_motion = motions.dt * np.arange(motions.horizon + 1)
print()
for name, qpos in retargeted.items():
    by_time = np.asarray(distance(motions.qpos, qpos))
    step = np.abs(np.diff(qpos, axis=1)).max()
    print(f"{name:14}  mean distance {by_time.mean():.4f}   largest step of a joint {step:.2f} rad")
    axes[0].plot(seconds_of_motion, by_time[0], label=name)
for joint, joint_name in enumerate(learner.joint_names):
    (line,) = axes[1].plot(seconds_of_motion, retargeted["optimiser"][0, :, joint], label=joint_name)
    axes[1].plot(seconds_of_motion, retargeted["mapper"][0, :, joint], "--", color=line.get_color())
axes[0].set(xlabel="time [s]", ylabel="embodiment distance", title="the first motion")
axes[1].set(xlabel="time [s]", ylabel="angle [rad]", title="optimiser (lines) and mapper (dashed)")
for axis in axes:
    axis.legend(fontsize=8)
figure.savefig(out / "retargeted.png", dpi=100)
print(f"results: {out}")
