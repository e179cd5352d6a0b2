"""7. Your own arm: from a model file to a trained policy.

    python examples/07_own_arm.py [FOLDER]

The example writes its own model file. Any MJCF or URDF file of a serial arm can be used instead.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import mimic

out = Path(sys.argv[1] if len(sys.argv) > 1 else time.strftime("examples_out/07_own_arm-%Y%m%d-%H%M%S"))
out.mkdir(parents=True, exist_ok=True)


def command(name, *arguments, check=True):
    """Prints the shell command `python -m mimic.NAME ...` and runs it."""
    print(f"\n$ python -m mimic.{name} {' '.join(arguments)}", flush=True)
    return subprocess.run([sys.executable, "-m", f"mimic.{name}", *arguments], check=check)


# ---- A model ---------------------------------------------------------------------------------------------------------
#
# Five revolute joints: base, shoulder, elbow, and two in the wrist. Each body is a capsule, whose mass and shape give
# its inertia. The finger of the gripper slides, so it is not part of the chain; its mass is kept. The actuators set
# the torque limits. Armature is the rotor's inertia reflected to the joint. Many models lack it, and then random
# torques spin light wrist links up before anything is learned.

JOINTS = (  # name, axis, offset of its body in the parent body [m], length [m], mass [kg], torque limit [N m]
    ("turn", "0 0 1", 0.0, 0.25, 3.0, 60),
    ("shoulder", "0 1 0", 0.25, 0.35, 2.5, 60),
    ("elbow", "0 1 0", 0.35, 0.30, 1.5, 40),
    ("bend", "0 1 0", 0.30, 0.12, 0.6, 15),
    ("roll", "0 0 1", 0.12, 0.10, 0.3, 15),
)
bodies = ""
for name, axis, offset, length, mass, _ in JOINTS:
    bodies += f"""
      <body name="{name}_link" pos="0 0 {offset}">
        <joint name="{name}" axis="{axis}" range="-150 150" armature="0.1" damping="1"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 {length}" mass="{mass}"/>"""
motors = "".join(f'\n    <motor joint="{name}" ctrlrange="-{torque} {torque}"/>' for name, *_, torque in JOINTS)
arm_file = out / "arm.xml"
arm_file.write_text(f"""<mujoco model="five">
  <worldbody>{bodies}
        <body name="gripper" pos="0 0 0.1"><joint name="finger" type="slide" axis="1 0 0" range="0 0.04"/>
          <geom type="box" size="0.02 0.04 0.03" pos="0 0 0.03" mass="0.2"/></body>{"</body>" * len(JOINTS)}
  </worldbody>
  <actuator>{motors}
  </actuator>
</mujoco>
""")

# ---- The embodiment --------------------------------------------------------------------------------------------------
#
# A link goes from each joint to the next one, and the last link to the tip. The metric uses this embodiment, like those
# of the previous examples.

arm = mimic.load_mjcf(arm_file)
print(f"{arm.name}: {arm.num_joints} joints ({', '.join(arm.joint_names)}), {arm.chain_length:.2f} m long")
for name, length in zip(arm.link_names, arm.link_lengths, strict=True):
    print(f"  {name}  {length:.2f} m")

# ---- Inspection ------------------------------------------------------------------------------------------------------
#
# `inspect` checks a model before training. It lists joints and links, what is ignored (the sliding joint, gravity,
# contacts) and what is assumed (velocity limits, for which MJCF has no attribute), and how well these joints can
# imitate a Panda's motions. Its last line is the command that trains a policy.

command("inspect", str(arm_file), f"out={out / 'inspected'}")
inspection = json.loads((out / "inspected" / "inspection.json").read_text())
print(f"\nat best, the distance to the Panda's motions is {1 - inspection['bound'] / inspection['hold']:.0%} smaller "
      "than that of holding the start pose")  # fmt: skip

# Wrong input ends with one line and exit code 2; here the tip is not in the file.

rejected = command("inspect", str(arm_file), "learner.tip=hand", check=False)
print(f"exit code: {rejected.returncode}")

# ---- Training --------------------------------------------------------------------------------------------------------
#
# `env=pair` trains any pair of arms; the expert is the Panda by default. This training is a test that everything works:
# eight demonstrations, and 4 % of the default number of steps on CPUs.

run = out / "run"
command(
    "train", "env=pair", f"env.learner={arm_file}", "env.demonstrations.count=8",
    "env.demonstrations.held_out=2", "trainer.preset=cpu", "trainer.num_envs=128", "trainer.batch_size=64",
    "trainer.num_minibatches=16", "trainer.num_timesteps=120000", "trainer.evaluations=2", f"run_dir={run}",
)  # fmt: skip
report = json.loads((run / "report.json").read_text())
gap = report["optimality_gap"]
print(
    f"\ngap after {report['env_steps']:,} steps: {gap['train']:.0%} on training demonstrations, "
    f"{gap['held_out']:.0%} on held-out ones"
)

# 0 is the kinematic bound, 1 is holding the start pose. The policy imitates its eight training motions roughly, and
# others hardly at all: that needs more demonstrations and more steps. A gap above 1 does not mean that the arm cannot
# do better: an untrained policy moves at random, which is worse than holding the start pose. The command that `inspect`
# printed trains on 600 demonstrations, for ten minutes or more on two cores.

print(f"kinematic bound: {report['lower_bound']['held_out']:.3f}, "
      f"holding the start pose: {report['hold_distance']['held_out']:.3f}")  # fmt: skip
print(f"for a full training: {inspection['train']}")
print(f"results: {out}")
