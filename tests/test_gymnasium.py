"""The environments with Gymnasium's interface: its own checks, and the values of the brax environment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from mimic.gymnasium import Env, VectorEnv  # noqa: E402

SMALL = {"demonstrations": {"count": 3, "held_out": 1}}


@pytest.fixture(scope="module")
def imitation():
    return mimic.make("planar4dof", horizon=6, **SMALL)


@pytest.fixture(scope="module")
def vector(imitation):
    return VectorEnv(imitation, num_envs=5)


def test_gymnasium_finds_nothing_wrong():
    env = gymnasium.make("mimic/planar4dof-v0", **SMALL)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_all_environments_are_registered():
    for name in mimic.environments():
        assert gymnasium.spec(f"mimic/{name}-v0").vector_entry_point == "mimic.gymnasium:VectorEnv"
    env = gymnasium.make_vec("mimic/planar4dof-v0", num_envs=2, **SMALL)
    assert isinstance(env.unwrapped, VectorEnv) and env.num_envs == 2


@pytest.mark.parametrize("name", ["any_arm", "panda_family"])
def test_environments_of_many_arms_are_rejected(name):
    with pytest.raises(ValueError, match=f"env: expected an environment of one learner, got '{name}', which draws"):
        gymnasium.make(f"mimic/{name}-v0")
    with pytest.raises(ValueError, match="env: expected an environment of one learner"):
        VectorEnv(name, num_envs=2)


def test_it_equals_the_brax_environment(imitation):
    env = Env(imitation)
    obs, _ = env.reset(seed=3, options={"demonstration": 2})
    state = imitation.begin(imitation.start(jax.random.PRNGKey(0), 2))
    np.testing.assert_allclose(obs, state.obs, atol=1e-6)
    step, actions = jax.jit(imitation.step), np.random.default_rng(0).uniform(-1, 1, (6, 4)).astype(np.float32)
    for index, action in enumerate(actions):
        obs, reward, terminated, truncated, infos = env.step(action)
        state = step(state, jnp.asarray(action))
        np.testing.assert_allclose(obs, state.obs, atol=1e-6)
        assert reward == pytest.approx(float(state.reward), abs=1e-6)
        assert infos["distance"] == pytest.approx(float(state.metrics["distance"]), abs=1e-6)
        assert (terminated, truncated) == (index == 5, False)


def test_arms_restart_in_the_step_that_ends_an_episode(imitation, vector):
    assert vector.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    obs, _ = vector.reset(seed=0)
    assert obs.shape == (5, imitation.observation_size) and vector.observation_space.contains(obs)
    own = 12 * imitation.learner.num_links
    at_home = obs[0, :own]
    for index in range(13):
        action = vector.action_space.sample()
        obs, reward, terminated, truncated, infos = vector.step(action)
        ends = index % 6 == 5
        assert terminated.tolist() == [ends] * 5 and not truncated.any() and reward.dtype == float
        assert infos["distance"].shape == (5,) and infos["_distance"].all()
        assert ("final_obs" in infos) == ends
        np.testing.assert_array_equal(np.all(obs[:, :own] == at_home, axis=1), ends)
        if ends:
            assert infos["_final_obs"].all() and not np.any(np.all(infos["final_obs"][:, :own] == at_home, axis=1))


def test_a_seed_repeats_everything(vector):
    actions = np.random.default_rng(1).uniform(-1, 1, (8, *vector.action_space.shape))

    def play(seed):
        obs = [vector.reset(seed=seed)[0]]
        return np.stack(obs + [vector.step(action)[0] for action in actions])

    np.testing.assert_array_equal(play(4), play(4))
    assert np.any(play(4) != play(5))
    assert len(np.unique(play(4)[0], axis=0)) > 1  # arms do not all imitate the same demonstration


@pytest.mark.slow
def test_pictures(imitation):
    """The image of an arm is that of the first of many arms in the same state."""
    env, many = Env(imitation, render_mode="rgb_array"), VectorEnv(imitation, num_envs=1, render_mode="rgb_array")
    env.reset(seed=0, options={"demonstration": 0})
    many.reset(seed=0)
    try:
        picture = env.render()
    except ValueError as error:
        pytest.skip(str(error))
    env.close()
    pictures = many.render()
    many.close()
    assert pictures is not None and len(pictures) == 1 and picture is not None
    assert picture.shape == pictures[0].shape == (480, 640, 3) and picture.dtype == np.uint8 and np.ptp(picture) > 0
    assert Env(imitation).render() is None


def test_bad_input(imitation, vector):
    with pytest.raises(ValueError, match="num_envs: expected at least 1"):
        VectorEnv(imitation, num_envs=0)
    with pytest.raises(ValueError, match="render_mode: expected one of rgb_array, got 'human'"):
        Env(imitation, render_mode="human")
    with pytest.raises(ValueError, match="unknown environment 'panda9dof'"):
        Env("panda9dof")
    with pytest.raises(ValueError, match="preview: expected the name of an environment"):
        Env(imitation, preview=2)
    with pytest.raises(ValueError, match="expected a call of reset before"):
        Env(imitation).step(np.zeros(4))
    with pytest.raises(ValueError, match="demonstration: expected a number from 0 to 2, got 3"):
        Env(imitation).reset(options={"demonstration": 3})
    vector.reset()
    with pytest.raises(ValueError, match=r"action: expected shape \(5, 4\), got \(4,\)"):
        vector.step(np.zeros(4))
