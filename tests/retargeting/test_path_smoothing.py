"""Postures smoothed over time."""

import numpy as np

from mimic.retargeting.path_smoothing import least_change

TIMES = 60
JITTER = 0.1 * (-1.0) ** np.arange(TIMES)  # rad
SWING = 0.5 * np.sin(np.arange(TIMES) / 20)


def test_what_moves_the_hand_stays_and_the_rest_is_smoothed():
    """The hand feels the first joint alone."""
    path = np.stack([SWING + JITTER, JITTER], axis=1)
    stiffness = np.broadcast_to(np.diag([1.0, 0.0]), (TIMES, 2, 2))
    movable = np.arange(TIMES) != 30
    smooth = least_change(path, path, stiffness, movable, np.array([0.1, 0.3]))
    np.testing.assert_allclose(smooth[:, 0], path[:, 0], atol=1e-3)
    np.testing.assert_allclose(smooth[30], path[30], atol=1e-3)  # this time is held
    away = np.abs(np.arange(TIMES) - 30) > 25
    assert np.abs(smooth[away, 1]).max() < 0.2 * np.abs(JITTER).max()  # exp(-2.5) is 0.08


def test_the_band_is_the_dense_system():
    generator, joints = np.random.default_rng(0), 3
    path, original = generator.normal(size=(2, 7, joints))
    root = generator.normal(size=(7, joints, joints))
    stiffness, jump = root @ np.swapaxes(root, 1, 2), np.array([0.1, 0.2, 0.4])
    smooth = least_change(path, original, stiffness, np.ones(7, bool), jump)
    weight = np.square(jump.mean() / jump)

    def gradient(qpos):
        steps = np.diff(qpos, axis=0)
        of_steps = np.pad(steps, ((1, 0), (0, 0))) - np.pad(steps, ((0, 1), (0, 0)))
        return weight * (of_steps + (qpos - original) / 10**2) + 1e4 * np.einsum("tij,tj->ti", stiffness, qpos - path)

    np.testing.assert_allclose(gradient(smooth), 0, atol=1e-8)  # of 1e4 times the stiffness
