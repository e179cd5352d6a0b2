"""Where the learner starts its episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.envs.imitation import ImitationEnv, training_and_held_out
from mimic.envs.start_poses import CLEARANCE, start_poses
from mimic.envs.wrappers import fresh_episodes
from mimic.evaluation.evaluator import Evaluator
from mimic.evaluation.rollout_frames import RolloutFrames
from mimic.metric.capsule_distances import capsule_axes, pair_distances
from mimic.motions.demonstrations import Demonstrations
from tests.helpers.tiny import SHORT_ARMS

SETTINGS = {"demonstrations": {"count": 3, "held_out": 2}, "horizon": 6}


def moved(demonstrations, seed):
    """The same motions, each around another pose, where they start."""
    offsets = np.random.default_rng(seed).uniform(-1, 1, (demonstrations.count, 1, demonstrations.qpos.shape[2]))
    values = {name: getattr(demonstrations, name) for name in ("dt", "arm", "joint_names", "qvel")}
    return Demonstrations(qpos=demonstrations.qpos + offsets, goals=demonstrations.goals + offsets[:, 0], **values)


@pytest.fixture(scope="module")
def evaluator():
    config = mimic.env_config("planar4dof", **SHORT_ARMS, **SETTINGS)
    training, held_out = training_and_held_out(config)
    return Evaluator(ImitationEnv(config, moved(training, 0)), moved(held_out, 1))


@pytest.mark.slow
def test_each_episode_starts_at_rest_in_the_nearest_pose_of_its_demonstration(evaluator):
    env = evaluator.env
    start_of, begin, distance, observe = map(jax.jit, (env.start, env.begin, env.distance, env.observe))

    def distance_of(demonstration, qpos):
        return float(distance(qpos, np.zeros(len(qpos), np.float32), demonstration, 0))

    for demonstration in range(env.demonstrations.count):
        start = start_of(jax.random.PRNGKey(0), demonstration)
        np.testing.assert_array_equal(start.qpos, env.start_poses[demonstration])
        assert not np.any(start.qvel)
        # Of the static distance: the expert's velocity at its first step is zero here.
        poses = np.random.default_rng(0).normal(start.qpos, 0.3, (20, env.action_size)).astype(np.float32)
        nearest = distance_of(demonstration, start.qpos)
        assert nearest < min(distance_of(demonstration, pose) for pose in poses)
        assert nearest < distance_of(demonstration, np.asarray(env.learner.home, np.float32)) - 0.05
        np.testing.assert_allclose(begin(start).obs, observe(start), atol=1e-6)


@pytest.mark.slow
def test_holding_the_start_pose_and_videos_begin_there(evaluator):
    env = evaluator.env
    still = np.tile(env.start_poses[:, None], (1, 6, 1))
    held = [
        [float(env.distance(still[i, t], jnp.zeros(2), jnp.asarray(i), jnp.asarray(t + 1))) for t in range(6)]
        for i in range(env.demonstrations.count)
    ]
    np.testing.assert_allclose(evaluator.hold_distance, held, atol=1e-5)
    rollouts = jax.jit(lambda: evaluator.rollout(lambda state: jnp.zeros(2)))()
    frames = RolloutFrames(evaluator, rollouts, 1, 30)
    np.testing.assert_allclose(frames.learner[0], env.start_poses[1], atol=1e-6)


def test_episodes_that_restart_do_so_where_their_demonstration_starts(evaluator):
    env = evaluator.env
    episodes = fresh_episodes(env)
    state = jax.jit(episodes.reset)(jax.random.split(jax.random.PRNGKey(0), 8))
    again = jax.jit(env.restart_done)(state.replace(done=jnp.ones(8)))
    for states in (state, again):
        arm = states.pipeline_state
        np.testing.assert_array_equal(arm.qpos, env.start_poses[np.asarray(arm.demonstration)])
        np.testing.assert_allclose(states.obs, jax.jit(jax.vmap(env.observe))(arm), atol=1e-6)


def test_the_learner_starts_at_home_where_the_expert_does():
    env = mimic.make("planar4dof", **SHORT_ARMS, **SETTINGS)
    np.testing.assert_array_equal(env.start_poses, np.tile(np.float32(env.learner.home), (3, 1)))
    qpos = np.stack([env.expert.home, env.expert.home + 0.3])
    poses = start_poses(env.expert, env.learner, qpos, env.metric.arguments)
    np.testing.assert_array_equal(poses[0], np.float32(env.learner.home))
    assert np.abs(poses[1] - poses[0]).max() > 0.1


@pytest.mark.slow
def test_the_experts_own_arm_starts_in_its_pose_within_its_range():
    """A measured angle may lie beyond the range."""
    arm = mimic.build_arm(mimic.ArmConfig("panda"), limits="hardware").embodiment
    lower, upper = np.asarray(arm.joint_range).T
    qpos = np.stack([0.5 * (lower + upper), upper + 0.01])
    poses = start_poses(arm, arm, qpos, {})
    np.testing.assert_allclose(poses, [0.5 * (lower + upper), upper], atol=1e-6)


def test_an_arm_that_is_charged_for_self_collision_starts_without():
    env = mimic.make("panda7dof", physics="fused", reward={"terms": {"self_collision": 1.0}}, **SETTINGS)
    qpos = np.zeros((2, 7))
    qpos[:, 1], qpos[:, 3] = 2.8, [-0.5, -2.0]  # the upper arm is folded down to the base
    arguments = env.expert, env.learner, qpos, env.metric.arguments

    def smallest_distance(pose):
        axes = capsule_axes(env.learner, env.capsules, jnp.asarray(pose))
        return float(pair_distances(env.capsules, *axes)[env.changing_pairs].min())

    assert max(map(smallest_distance, start_poses(*arguments))) < 0
    assert min(map(smallest_distance, start_poses(*arguments, env.capsules))) > 0.8 * CLEARANCE
