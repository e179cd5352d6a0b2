"""4. Train a neural pose mapper, and compare it with the optimiser on poses and on whole motions.

    python examples/04_pose_mapper.py [FOLDER]

Trains for some seconds. The default training, `python -m mimic.train trainer=pose_mapper`, is longer and far better.
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
    """Prints the shell command `python -m mimic.NAME ...` and runs it."""
    print(f"\n$ python -m mimic.{name} {' '.join(arguments)}", flush=True)
    subprocess.run([sys.executable, "-m", f"mimic.{name}", *arguments], check=True)


# ---- Training --------------------------------------------------------------------------------------------------------
#
# The network maps a pose of the expert to a pose of the learner. It needs no labels: the loss is the embodiment
# distance of the two poses, differentiated through both kinematics. The network has four heads (`trainer.heads`), each
# of which proposes a pose; the nearest one is used. The optimal pose jumps as the expert moves: a choice between heads
# can follow that, one continuous function cannot.
#
# A training writes everything into its run directory. This one is short and its network small: three epochs instead of
# the default's thirty.

mapper_run = out / "mapper"
command(
    "train", "trainer=pose_mapper", "env=panda4dof", "trainer.epochs=3", "trainer.evaluations=3",
    "trainer.hidden_layers=[64,64]", "trainer.held_out_poses=500", f"run_dir={mapper_run}",
)  # fmt: skip
report = json.loads((mapper_run / "report.json").read_text())
print(f"\nquality on unseen poses, 0 for the optimiser and 1 for a random pose: {report['quality']['held_out']:.1%}")

# ---- One pose at a time ----------------------------------------------------------------------------------------------
#
# A mapper takes one pose or a batch. It is far faster than the optimiser, because it searches nothing.

mapper = mimic.PoseMapper.load(mapper_run)
env = mimic.env_config("panda4dof")
expert, learner = mapper.expert, mapper.learner
correspondence, weights = env.metric.make_correspondence(expert, learner), env.metric.make_weights()
poses = np.random.default_rng(0).uniform(-np.pi, np.pi, (2000, 7)).astype(np.float32)


def seconds(function):
    """Seconds of a call after compilation."""
    jax.block_until_ready(function(poses))
    began = time.perf_counter()
    jax.block_until_ready(function(poses))
    return time.perf_counter() - began


optimise = jax.jit(lambda qpos: mimic.imitate_pose(expert, learner, qpos, correspondence, weights).qpos)
for name, function in (("optimiser", optimise), ("mapper", jax.jit(mapper))):
    print(f"{name:9}  {len(poses) / seconds(function):9,.0f} poses a second")

# ---- A whole motion --------------------------------------------------------------------------------------------------
#
# A motion must be continuous, and no joint may exceed its velocity limit. `mimic.retarget` ensures both: it tracks
# minima over time. A mapper maps each pose alone, and may jump from one minimum to another. First, motions of the
# expert to retarget:

motions = mimic.record_demonstrations(mimic.build_arm(env.expert), 4)
motions.save(out / "expert.npz")
command(
    "retarget", f"source={out / 'expert.npz'}", "learner=panda4dof", "hand=scaled", "limits=none",
    f"out={out / 'optimised'}",
)  # fmt: skip

# ---- Compare the motions ---------------------------------------------------------------------------------------------
#
# Both motions are compared by their distance over time; a learner that holds its zero pose sets the scale. The
# optimiser's motion is not a bound: a better pose may need a jump, as the mapper's may. Motions start at the learner's
# optimal pose, not in its zero pose; a robot must move there first.

distance = jax.jit(
    jax.vmap(
        jax.vmap(
            lambda qpos, learner_qpos: mimic.embodiment_distance(
                mimic.link_states(expert, qpos), mimic.link_states(learner, learner_qpos), correspondence, weights
            )
        )
    )
)
retargeted = {
    "optimiser": mimic.load_demonstrations(out / "optimised" / "expert.npz").qpos,
    "mapper": np.unwrap(jax.jit(mapper)(motions.qpos.astype(np.float32)), axis=1),
}
retargeted["zero pose"] = np.zeros_like(retargeted["mapper"])
figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
seconds_of_motion = motions.dt * np.arange(motions.horizon + 1)
print()
for name, qpos in retargeted.items():
    by_time = np.asarray(distance(motions.qpos, qpos))
    step = np.abs(np.diff(qpos, axis=1)).max()
    print(f"{name:14}  mean distance {by_time.mean():.4f}   maximum step of a joint {step:.2f} rad")
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
