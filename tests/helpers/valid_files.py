"""Valid files of each kind that mimic reads: motions, models, clips, a run directory, command lines."""

import importlib.util
from pathlib import Path

import numpy as np

import mimic
from mimic.motions.demonstrations import Demonstrations
from mimic.motions.formats.lerobot import write_lerobot
from mimic.motions.formats.rosbag2 import write_rosbag2
from mimic.runs.checkpoints import save_checkpoint
from tests.helpers import bodies, episodes, original_model
from tests.helpers.run_directories import write_run

ARM = mimic.planar_arm([0.5, 0.3, 0.2])
PARAMS = {"layer": {"kernel": np.arange(6, dtype=np.float32).reshape(2, 3), "bias": np.ones(3, np.float32)}}


def write_motions(folder: Path) -> None:
    time_, qpos = 0.1 * np.arange(60), 0.1 * np.sin(0.1 * np.arange(60)[:, None] * [1, 2, 3])
    arrays = {"qpos": qpos, "joint_names": np.array(ARM.joint_names), "frequency": np.array(10.0)}
    np.savez_compressed(folder / "imported.npz", **arrays)  # type: ignore[arg-type]
    names = ",".join(("time", *ARM.joint_names))
    np.savetxt(folder / "imported.csv", np.column_stack([time_, qpos]), delimiter=",", header=names, comments="")
    if importlib.util.find_spec("h5py"):
        import h5py

        model = "".join(f'<body><joint name="{name}"/></body>' for name in ARM.joint_names)
        with h5py.File(folder / "imported.hdf5", "w") as file:
            file["demo_1/states"] = np.column_stack([time_, qpos, 0 * qpos])
            file["demo_1"].attrs["model_file"] = f"<mujoco><worldbody>{model}</worldbody></mujoco>"
    several = np.stack([qpos, -qpos])
    Demonstrations(several, 0 * several, several[:, -1], 0.1, ARM.name, ARM.joint_names).save(folder / "recorded.npz")
    for name, write in {"lerobot": write_lerobot, "bags": write_rosbag2}.items():
        if importlib.util.find_spec({"lerobot": "pyarrow", "bags": "rosbags"}[name]):
            (folder / name).mkdir()
            write(folder / name, episodes.episodes())


def write_models(folder: Path) -> None:
    (folder / "arm").mkdir()
    tool = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (folder / "arm" / "tool.obj").write_text(tool)
    (folder / "arm" / "parts.xml").write_text('<x><numeric name="velocity_limit" data="1 2 3 4 5 6"/></x>')
    extras = '<asset><mesh file="tool.obj"/></asset><custom><include file="parts.xml"/></custom><worldbody>'
    hand = '<body><geom type="mesh" mesh="tool" mass="0.1"/></body>'
    arm = original_model.ur_like(gripper=hand).replace("<worldbody>", extras, 1)
    (folder / "arm" / "arm.xml").write_text(arm)
    (folder / "arm" / "arm.urdf").write_text(original_model.urdf(mesh="tool.obj"))


def write_captures(folder: Path) -> None:
    body = bodies.person(12)
    time_, positions = np.arange(12) / bodies.RATE, body.positions.reshape(12, -1)
    (folder / "clip.bvh").write_text(bodies.bvh_text(12))
    header = ",".join(["time", *(f"{name}_{axis}" for name in body.names for axis in "xyz")])
    np.savetxt(folder / "clip.csv", np.column_stack([time_, positions]), "%.6f", ",", header=header, comments="")
    bodies.write_npz(folder / "clip.npz", body.names, body.positions)
    bodies.write_trc(folder / "clip.trc", body)
    if importlib.util.find_spec("ezc3d"):
        bodies.write_c3d(folder / "clip.c3d", 1000 * body.positions, LABELS=list(body.names))


def write_runs(folder: Path) -> None:
    run_dir = write_run(folder / "run", [0.5, 0.3, 0.2])
    save_checkpoint(run_dir, 3000, PARAMS, [np.arange(4), np.eye(2)], {"loss": 0.5})
    plan = '{"runs": [{"label": "seed=0", "overrides": ["seed=0"], "run_dir": "run", "exit_code": 1, "reason": "x"}]}'
    (folder / "sweep.json").write_text(plan)


def write_command_lines(folder: Path) -> None:
    small = "env=planar4dof env.demonstrations.count=2 env.horizon=5 env.learner.damping=0.1 seed=1 logger=local"
    lines = {
        "train": f"{small} env.learner.locked={{joint1:0.1}} metric=paper env.world=ideal run_dir=run -m --cfg=job",
        "train_ppo": f"{small} trainer=ppo trainer.num_envs=64 trainer.hidden_layers=[8,8] trainer.entropy_cost=0.01",
        "train_mapper": f"{small} trainer=pose_mapper trainer.samples=64 trainer.epochs=2 trainer.learning_rate=1e-3",
        "evaluate": "run=run checkpoint=3 controller=policy physics=mjx out=out",
        "render": "run=run demonstration=1 split=train",
        "retarget": "source=d.npz learner=planar4dof limits=none hand=scaled out=o seed=1",
        "demonstrations": "env=planar4dof count=3 source=m.csv joints=[a,b] capture.cutoff=6 out=d.npz",
        "view": "env=pair expert=panda port=8080 host=127.0.0.1 split=train",
        "dataset": "run=run format=lerobot task=move out=out",
        "inspect": "learner.model=arm.xml expert.model=panda limits=none bound=false",
        "collect": "folder=runs out=out",
        "export": "run=run format=onnx out=policy.onnx locked=[1] learner=pair",
    }
    for name, text in lines.items():
        (folder / name).write_text(text.replace(" ", "\n"))
