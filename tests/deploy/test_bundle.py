"""Controller bundles: what is written is read, and what does not fit is rejected in one line."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from mimic.control.joint_control import Reference
from mimic.deploy.bundle import load_bundle
from mimic.deploy.policy import Policy
from tests.helpers import bundles


@pytest.fixture
def bundle(tmp_path):
    return bundles.make_bundle(tmp_path / "bundle")


def test_a_bundle_is_read(bundle):
    assert (bundle.mode, bundle.ticks, bundle.periods) == ("joint_velocity", bundles.TICKS, 50)
    np.testing.assert_allclose(bundle.parameters.stiffness, bundles.parameters().stiffness)
    assert bundle.limits.velocity[0] == 2.175 and bundle.joint_names[0] == "joint1"
    assert bundle.motion_index("motion 1") == bundle.motion_index(1) == 1
    with pytest.raises(ValueError, match="motion: expected a number from 0 to 1 or a name such as 'motion 0', got 2"):
        bundle.motion_index(2)


def test_a_policy_observes_what_it_was_exported_for(bundle, monkeypatch):
    """Its last actions, the newest first, and the expert at the next ticks, the last one repeated at the end."""
    feeds, policy = [], Policy(bundle, [1, 0])

    def run(_, feed):
        feeds.append(feed)
        return [np.full((2, 7), float(len(feeds)), np.float32)]

    monkeypatch.setattr(policy, "_session", SimpleNamespace(run=run))
    rows = np.zeros((2, 7))
    for tick in (0, 1, bundle.ticks):
        action = policy.act(tick, rows + 1, rows + 2, Reference(rows + 3, rows + 4, rows))
    assert action.shape == (2, 7) and action[0, 0] == 3
    last = feeds[-1]
    assert [last[name][0, 0] for name in ("qpos", "qvel", "reference_qpos", "reference_qvel")] == [1, 2, 3, 4]
    np.testing.assert_array_equal(last["past_actions"][0, ::7], [2, 1, 0])
    phases = [feed["expert"][0, :: 12 * bundles.LINKS] for feed in feeds]
    step = 2 * np.pi * bundles.CONTROL_DT
    np.testing.assert_allclose(phases[1], step * np.array([1, 2, 3]), rtol=1e-6)
    np.testing.assert_allclose(phases[2], step * bundle.ticks, rtol=1e-6)


def test_the_clearance_is_that_of_the_arm(bundle):
    home, on_floor, folded = bundle.clearance_of(np.stack([bundle.start_pose, bundles.ON_FLOOR, bundles.FOLDED]))
    assert 0.05 < home < 0.2 and on_floor < -0.1 and folded < -0.02


def changed(folder, **changes):
    path = folder / "controller.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, **changes}))


def motions(folder, **changes):
    with np.load(folder / "motions.npz") as content:
        arrays = {**content, **changes}
    np.savez(folder / "motions.npz", **arrays)


BROKEN = {
    "no folder": (lambda folder: (folder / "policy.onnx").unlink(), "expected a folder of mimic.export"),
    "no JSON": (lambda folder: (folder / "controller.json").write_text("{"), "controller.json: expected JSON"),
    "no key": (lambda folder: (folder / "controller.json").write_text("{}"), "missing format, mimic_version"),
    "another format": (lambda folder: changed(folder, format=1), "format: expected 4, got 1; export the run again"),
    "another network": (lambda folder: (folder / "policy.onnx").write_bytes(b"x"), "policy.onnx: expected the file"),
    "no motions": (lambda folder: (folder / "motions.npz").write_bytes(b"x"), "motions.npz: "),
    "a mode": (lambda folder: changed(folder, mode="flying"), "mode: expected one of torque, joint_position"),
    "a tick": (lambda folder: changed(folder, control_dt=0.0505), "control_dt: expected a multiple of 0.001 s"),
    "no hashes": (lambda folder: changed(folder, hashes=None), "hashes: expected one for each file, got None"),
    "an expert of one dimension": (
        lambda folder: motions(folder, expert=np.zeros(4)),
        "expert: expected [motions, ticks + 1, numbers], got (4,)",
    ),
    "joints": (lambda folder: changed(folder, joint_names=["one"]), "expected the shape"),
    "a number": (lambda folder: changed(folder, start_pose=[float("nan")] * 7), "start_pose: expected finite numbers"),
    "parameters": (lambda folder: changed(folder, parameters={}), "expected numbers and names of a controller"),
}


@pytest.mark.parametrize(("damage", "message"), BROKEN.values(), ids=BROKEN)
def test_a_broken_bundle_is_rejected_in_one_line(bundle, damage, message):
    damage(bundle.folder)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        load_bundle(bundle.folder)
    assert "\n" not in str(error.value)


def test_a_network_with_other_inputs_is_rejected(tmp_path):
    of_four = bundles.policy(4, 4, lambda values: values["qpos"])
    other = bundles.make_bundle(tmp_path / "other", network=of_four)
    with pytest.raises(ValueError, match="policy.onnx: inputs: expected expert \\[252\\], past_actions \\[21\\], qpos"):
        Policy(other, [0])


def test_the_clearance_of_another_arm_is_rejected(tmp_path):
    clearance = bundles.panda_clearance((3, 6, 7))
    with pytest.raises(ValueError, match="clearance.npz: parent: expected finite numbers of the shape \\(7,\\)"):
        bundles.make_bundle(tmp_path / "bundle", clearance=clearance)


def test_a_clearance_whose_joints_do_not_follow_their_parents_is_rejected(tmp_path):
    clearance = bundles.panda_clearance()._replace(parent=[0, 0, 1, 2, 3, 4, 5])
    with pytest.raises(ValueError, match="clearance.npz: expected parents before their children"):
        bundles.make_bundle(tmp_path / "bundle", clearance=clearance)
