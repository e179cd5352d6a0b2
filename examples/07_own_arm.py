"""7. An arm of your own: from a file to a trained policy.

    python examples/07_own_arm.py [FOLDER]

The file is written here, so that the example needs none; any MJCF or URDF of a serial arm will do instead.
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
    """Runs `python -m mimic.NAME`, and shows the line that does the same in a shell."""
    print(f"\n$ python -m mimic.{name} {' '.join(arguments)}", flush=True)
    return subprocess.run([sys.executable, "-m", f"mimic.{name}", *arguments], check=check)


# ---- A model ---------------------------------------------------------------------------------------------------------
#
# Five hinges: a base that turns, shoulder and elbow, and a wrist that bends and turns. Each body has a capsule, whose
# mass and shape give its inertia. The gripper at the end slides, so it is no part of the chain; it stays as mass.
# Actuators say how strong each joint is. Armature is the inertia of a motor's rotor as the joint feels it; many models
# lack it, and then light wrists spin under random torques before anything is learned.

JOINTS = (  # name, axis, offset of its body in the body before [m], length [m], mass [kg], largest torque [N m]
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

# ---- What the metric makes of it -------------------------------------------------------------------------------------
#
# Links go from each joint to the next, the last one to the tip. `roll` and `turn` move no link sideways, but they turn
# all that comes behind them. What the metric sees of the arm is an embodiment, like those of the examples before.

arm = mimic.load_mjcf(arm_file)
print(f"{arm.name}: {arm.num_joints} joints ({', '.join(arm.joint_names)}), {arm.chain_length:.2f} m long")
for name, length in zip(arm.link_names, arm.link_lengths, strict=True):
    print(f"  {name}  {length:.2f} m")

# ---- Inspection ------------------------------------------------------------------------------------------------------
#
# What would fail in training is found before. `inspect` lists joints and links, says what of the model is set aside
# (the slide, gravity, contacts) and what is assumed (rated speeds, of which MJCF has none), and tells how much of a
# Panda's motions these joints can imitate at all. The last line is the command that trains it.

command("inspect", str(arm_file), f"out={out / 'inspected'}")
findings = json.loads((out / "inspected" / "inspection.json").read_text())
print(f"\nof what the Panda does, {1 - findings['bound'] / findings['hold']:.0%} can be imitated, "
      "measured by the distance; the rest no policy can")  # fmt: skip

# A mistake ends with one line and exit code 2, here a tip that is not in the file.

refused = command("inspect", str(arm_file), "learner.tip=hand", check=False)
print(f"exit code: {refused.returncode}")

# ---- Training --------------------------------------------------------------------------------------------------------
#
# `env=pair` takes two arms; the expert is the Panda where none is named. This is a test that all is in place: eight
# demonstrations, and a twenty-fifth of the steps that are made on CPUs by default.

run = out / "run"
command(
    "train", "env=pair", f"env.learner={arm_file}", "env.physics=fused", "env.demonstrations.count=8",
    "env.demonstrations.held_out=2", "trainer.preset=cpu", "trainer.num_envs=128", "trainer.batch_size=64",
    "trainer.num_minibatches=16", "trainer.num_timesteps=120000", "trainer.evaluations=2", f"run_dir={run}",
)  # fmt: skip
report = json.loads((run / "report.json").read_text())
gap = report["optimality_gap"]
print(
    f"\ngap after {report['env_steps']:,} steps: {gap['train']:.0%} on training demonstrations, "
    f"{gap['held_out']:.0%} on held-out ones"
)

# 0 is the kinematic bound, 1 is holding the start pose. The policy knows its eight motions roughly, and next to nothing
# of others: that takes more of them, and more steps. A gap above 1 is no failure of the arm: a policy that has not
# learned moves about, which is worse than to stay. The command that `inspect` proposed trains on 124, for ten minutes
# or more on two cores.

print(f"kinematic bound: {report['lower_bound']['held_out']:.3f}, "
      f"holding the start pose: {report['hold_distance']['held_out']:.3f}")  # fmt: skip
print(f"to train it in earnest: {findings['train']}")
print(f"results: {out}")
