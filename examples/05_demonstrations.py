"""5. Demonstrations: record them, import your own, and see how well a learner can imitate them.

    python examples/05_demonstrations.py [FOLDER]

Writes demonstrations and pictures of them into FOLDER (a new one in examples_out by default).
"""

import csv
import subprocess
import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

import mimic

out = Path(sys.argv[1] if len(sys.argv) > 1 else time.strftime("examples_out/05_demonstrations-%Y%m%d-%H%M%S"))
out.mkdir(parents=True, exist_ok=True)

# ---- Recording -------------------------------------------------------------------------------------------------------
#
# The expert is simulated in C MuJoCo and moves to random goals: by a PID controller for each joint ("pid", as in the
# paper), by exact inverse dynamics ("computed_torque"), with the hand on a straight line ("reach"), through several
# goals ("splines") or to one that changes ("steps"). Goals whose motions exceed a torque, velocity or joint limit are
# resampled. A demonstration has 51 samples, 0.1 s apart, and the torque held in each interval.

panda = mimic.build_arm(mimic.ArmConfig())  # an embodiment, and a MuJoCo model to simulate it
expert = panda.embodiment
for kind in ("pid", "splines"):
    recorded = mimic.record_demonstrations(panda, 20, kind=kind, seed=0)
    assert recorded.torque is not None  # imported demonstrations have none, see below
    speed = np.abs(recorded.qvel).max(axis=(0, 1)) / expert.velocity_limit
    torque = np.abs(recorded.torque).max(axis=(0, 1)) / expert.torque_limit
    print(f"{kind}: angles {recorded.qpos.shape}, torques {recorded.torque.shape}")
    print(f"  maximum speed, as a fraction of its limit:  {' '.join(f'{fraction:.0%}' for fraction in speed)}")
    print(f"  maximum torque, as a fraction of its limit: {' '.join(f'{fraction:.0%}' for fraction in torque)}")

# They are saved in one file, without pickle, with the name of their arm. `python -m mimic.demonstrations out=FILE` does
# the same and plots them; `python -m mimic.train env.demonstrations.path=FILE` trains on them.

recorded.save(out / "recorded.npz")
print(f"read back: {mimic.load_demonstrations(out / 'recorded.npz').count} demonstrations of {recorded.arm!r}")

# ---- Your own --------------------------------------------------------------------------------------------------------
#
# A CSV file needs a column `time` and a column with the angle of each joint under its name. This one has two
# demonstrations, one after the other, at 50 samples a second: a wave of the whole arm, and the same at half the speed.

time_s = np.arange(0, 5.01, 0.02)
amplitude, frequency = np.array([0.6, 0.4, 0.5, 0.4, 0.6, 0.4, 0.6]), np.array([1.5, 1.0, 1.2, 1.4, 1.8, 1.6, 2.0])
with (out / "waves.csv").open("w", newline="") as file:
    table = csv.writer(file)
    table.writerow(["demonstration", "time", *expert.joint_names])
    for number, tempo in enumerate((1.0, 0.5)):
        for t in time_s:
            table.writerow([number, f"{t:.2f}", *(amplitude * np.sin(frequency * tempo * t) ** 2)])

# The import resamples to control steps and checks the expert's limits. The table has no velocities, so they are
# computed from the angles; the second result has a line about this, and about all else that was assumed or left out.
# The torques are unknown.

waves, notes = mimic.import_demonstrations(out / "waves.csv", expert)
print(f"\nwaves.csv: {waves.count} demonstrations, {waves.horizon} steps of {waves.dt} s", *notes, sep="\n")

# The same as a command, which writes the file and a picture of it:

arguments = [f"source={out / 'waves.csv'}", f"out={out / 'waves.npz'}"]
print(f"\n$ python -m mimic.demonstrations {' '.join(arguments)}", flush=True)
subprocess.run([sys.executable, "-m", "mimic.demonstrations", *arguments], check=True)

# ---- What is rejected ------------------------------------------------------------------------------------------------
#
# Most mistakes in such files are silent: degrees, a wrong column, another sample rate. A file must therefore be within
# the arm's joint ranges, and within three times its velocity limits, since the files of many arms state too little. The
# first file below is in degrees, the second twenty times too fast.

lines = (out / "waves.csv").read_text().splitlines()
rows = [line.split(",") for line in lines[1:]]
wrong_tables = {
    "degrees.csv": [[*row[:2], *(str(np.degrees(float(x))) for x in row[2:])] for row in rows],
    "clock.csv": [[row[0], str(float(row[1]) / 20), *row[2:]] for row in rows],
}
print()
for name, table_rows in wrong_tables.items():
    (out / name).write_text("\n".join([lines[0], *map(",".join, table_rows)]))
    try:
        mimic.import_demonstrations(out / name, expert, horizon=2)  # the second file has 0.25 s
    except ValueError as error:
        print(f"{name} is rejected: {error}")

# ---- How well can the learner imitate it? ----------------------------------------------------------------------------
#
# The kinematic bound is the minimum distance that the learner's joints allow, with four joints here. It needs no
# training, and no controller can go below it. It bounds each moment independently, so a motion that attains it
# throughout need not exist.

learner = mimic.panda(locked=(3, 6, 7))
metric = mimic.env_config("panda4dof").metric  # what a training would use
correspondence, weights = metric.make_correspondence(expert, learner), metric.make_weights()
bound = mimic.kinematic_bound(expert, learner, waves.qpos[0], waves.qvel[0], correspondence, weights)
print(f"\nmean kinematic bound over the first wave: {np.mean(bound):.4f}")

figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
steps = waves.dt * np.arange(waves.horizon + 1)
for joint in range(3):
    (line,) = axes[0].plot(time_s, amplitude[joint] * np.sin(frequency[joint] * time_s) ** 2, alpha=0.5)
    axes[0].plot(steps, waves.qpos[0, :, joint], ".", color=line.get_color(), label=expert.joint_names[joint])
axes[0].set(xlabel="time [s]", ylabel="angle [rad]", title="the table (lines) and its samples (dots)")
axes[0].legend(fontsize=8)
axes[1].plot(steps, np.asarray(bound))
axes[1].set(xlabel="time [s]", ylabel="embodiment distance", title="kinematic bound of a learner with four joints")
axes[1].set_ylim(bottom=0)
figure.savefig(out / "waves_and_bound.png", dpi=100)
print(f"results: {out}")
