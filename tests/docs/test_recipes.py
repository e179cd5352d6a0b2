"""What docs/recipes.md claims beyond its code; the recipes themselves run in test_pages.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from tests.helpers.pages import REPOSITORY, read_blocks

PAGE = REPOSITORY / "docs" / "recipes.md"
SMALL = {"physics": "fused", "horizon": 5, "demonstrations": {"count": 4, "held_out": 2}}


def block_with(text):
    """The block of the page that contains a text."""
    blocks = [block for block in read_blocks(PAGE.read_text()) if text in block.text]
    assert len(blocks) == 1
    return blocks[0].text


@pytest.mark.slow
def test_the_pure_jax_loop_learns():
    """With more updates than the page has: the mean return of the last tenth is above that of the first."""
    env = mimic.make("planar4dof", **SMALL)
    code = block_with("def update(carry, key)").replace("UPDATES, HIDDEN = 32, 5, 16", "UPDATES, HIDDEN = 32, 200, 16")
    scope: dict = {"env": env, "jax": jax, "jnp": jnp}
    exec(code, scope)  # noqa: S102 - our own text
    returns = np.asarray(scope["episode_returns"])
    assert len(returns) == 200
    assert returns[-20:].mean() > returns[:20].mean() + 0.1 * abs(returns[:20].mean())


def test_an_own_arm_starts_in_its_keyframe(own_registry, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "reacher.xml").write_text(block_with('<mujoco model="reacher">'))
    exec(block_with('"reacher.xml", "tip"'), {"mimic": mimic, "few": SMALL["demonstrations"]})  # noqa: S102
    np.testing.assert_allclose(mimic.make("reacher").learner.home, [0.5, -1.0], atol=1e-6)


@pytest.mark.slow
def test_stable_baselines3_trains(tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs Stable-Baselines3, which brings PyTorch")
    from mimic.gymnasium import VectorEnv

    scope: dict = {}
    exec(block_with("class Arms(VecEnv)"), scope)  # noqa: S102 - our own text
    from stable_baselines3 import PPO  # type: ignore[import-not-found]
    from stable_baselines3.common.vec_env import VecMonitor  # type: ignore[import-not-found]

    arms = VecMonitor(scope["Arms"](VectorEnv("planar4dof", num_envs=8, **SMALL)))
    trained = PPO("MlpPolicy", arms, n_steps=5, batch_size=20, device="cpu").learn(200)
    assert [episode["l"] for episode in trained.ep_info_buffer] == [SMALL["horizon"]] * (200 // SMALL["horizon"])


def test_the_end_of_an_episode_in_stable_baselines3():
    """The observation before the restart is that of the last step; an episode is never truncated."""
    pytest.importorskip("stable_baselines3", reason="needs Stable-Baselines3, which brings PyTorch")
    from mimic.gymnasium import VectorEnv

    scope: dict = {}
    exec(block_with("class Arms(VecEnv)"), scope)  # noqa: S102 - our own text
    arms = scope["Arms"](VectorEnv("planar4dof", num_envs=3, **SMALL))
    arms.seed(0)
    first, still = arms.reset(), np.zeros((3, *arms.action_space.shape), np.float32)
    for step in range(SMALL["horizon"]):
        observations, rewards, ended, infos = arms.step(still)
        assert ended.all() == (step == SMALL["horizon"] - 1) and rewards.shape == (3,)
    last = np.stack([info["terminal_observation"] for info in infos])
    assert not any(info["TimeLimit.truncated"] for info in infos)
    assert last.shape == first.shape and np.abs(last - observations).max(axis=1).min() > 0.01
