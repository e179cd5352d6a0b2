"""What a trainer's config resolves to."""

from mimic.trainers.config import PRESETS, PPOConfig


def test_a_run_with_a_target_looks_more_often():
    usual, targeted = (PPOConfig(target_gap=gap).resolve("cpu").evaluations for gap in (0.0, 0.02))
    assert usual and targeted
    assert usual == PRESETS["cpu"]["evaluations"] and targeted > usual
    assert PPOConfig(target_gap=0.02, evaluations=3).resolve("cpu").evaluations == 3
