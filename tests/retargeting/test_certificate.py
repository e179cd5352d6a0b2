"""Certificates of retargeted motions: what is exact, what fails, and why."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.arms.embodiment import without_hands
from mimic.retargeting.certificate import certify, hand_errors
from tests.helpers.bundles import FOLDED

ARM = dataclasses.replace(mimic.panda(), joint_range=np.array([[-3.0, 3.0]] * 7))
JUMP = np.full(7, 0.1)  # rad a frame
QPOS = np.linspace(0, 0.5, 20)[:, None] * np.linspace(1, 2, 7) + [0, 0.3, 0, -1.5, 0, 1.5, 0]


def causes(qpos, **options):
    return certify(ARM, ARM, QPOS, qpos, JUMP, **options).causes


def test_the_same_motion_is_exact():
    certificate = certify(ARM, ARM, QPOS, QPOS, JUMP)
    assert certificate.is_ok
    assert certificate.is_exact.all()
    summary = certificate.summary()
    assert summary["exact_frames"] == summary["frames"] == 20
    assert summary["largest_error_mm"] < 1e-3
    assert summary["largest_error_deg"] < 1e-3
    assert summary["largest_speed"] == pytest.approx(2 * 0.5 / 19 / 0.1)
    assert summary["smallest_margin_deg"] == pytest.approx(np.degrees(3 - QPOS.max()), rel=1e-6)


def test_errors_of_hands_that_an_arm_has_not_are_unknown():
    certificate = certify(ARM, without_hands(ARM), QPOS, QPOS, JUMP, demands_hand=False)
    assert certificate.is_ok and np.isnan(certificate.position).all() and not certificate.is_exact.any()


def test_the_hand_errors_are_those_of_a_rotation_of_the_last_joint():
    turned = QPOS + np.array([0, 0, 0, 0, 0, 0, 0.02])
    _, rotation = hand_errors(ARM, ARM, QPOS, turned, None)
    np.testing.assert_allclose(rotation, 0.02, rtol=1e-3)
    assert causes(turned) == ("hand out of reach",) * 20
    assert causes(turned, demands_hand=False) == ("",) * 20


@pytest.mark.parametrize(("half", "is_ok"), [(np.pi, True), (3.1, False)])
def test_a_range_of_one_revolution_is_no_limit(half, is_ok):
    """A joint without limits has it, and may go on."""
    ranges = np.tile([[-np.pi, np.pi]], (7, 1))
    ranges[6] = [-half, half]
    qpos = QPOS + np.array([0, 0, 0, 0, 0, 0, 2.5])
    arm = dataclasses.replace(ARM, joint_range=ranges)
    assert certify(arm, arm, qpos, qpos, JUMP).is_ok == is_ok


def test_a_base_is_where_the_learner_stands():
    base = [0.3, -0.1, 0.2, 0.7]
    turn = np.array([[np.cos(0.7), -np.sin(0.7), 0], [np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]])
    hand, other = (mimic.hand_frames(ARM, jnp.asarray(qpos)) for qpos in (QPOS, QPOS[::-1]))
    position, rotation = hand_errors(ARM, ARM, QPOS, QPOS[::-1], base)
    moved = np.asarray(other.position)[:, 0] @ turn.T + base[:3]
    np.testing.assert_allclose(position, np.linalg.norm(moved - np.asarray(hand.position)[:, 0], axis=1), atol=1e-6)
    product = np.swapaxes(np.asarray(hand.rotation)[:, 0], 1, 2) @ turn @ np.asarray(other.rotation)[:, 0]
    np.testing.assert_allclose(np.cos(rotation), (np.trace(product, axis1=1, axis2=2) - 1) / 2, atol=1e-5)


def test_failures_are_named_with_their_frames():
    beyond = QPOS.copy()
    beyond[5:8, 2] = 3.1
    found = list(certify(ARM, ARM, QPOS, beyond, JUMP).failures())
    assert (5, 7, "joint3 beyond its range") in found
    assert (4, 4, "joint3 beyond its velocity limit") in found
    slow = QPOS.copy()
    slow[10:] -= [0.05, 0, 0, 0, 0, 0, 0]
    slow[9] = slow[10] - [0.1, 0, 0, 0, 0, 0, 0]
    assert "hand not reached: joint1 is at its velocity limit" in causes(slow)


def test_touching_links_fail():
    capsules = mimic.fit_capsules(mimic.env_config("panda4dof").expert)
    arm, folded = dataclasses.replace(ARM, joint_range=np.array([[-4.0, 4.0]] * 7)), np.tile(FOLDED, (20, 1))
    certificate = certify(arm, arm, folded, folded, JUMP, capsules=capsules)
    assert np.all(certificate.clearance < 0) and set(certificate.causes) == {"links touch"}
    assert certificate.nearest == "the link of joint1 and the link of joint7"
