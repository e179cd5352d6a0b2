"""`HardwareEnv`: delays, losses and noise as its config says, and MJX as another physics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.envs import imitation
from mimic.envs.make import make_env
from mimic.envs.world_env import HardwareEnv, control_observation, expert_vector
from mimic.evaluation.evaluator import Evaluator
from mimic.physics.world import WorldConfig

FEW = {"count": 3, "held_out": 1}
TICKS = 6


def make(**fields) -> HardwareEnv:
    env = mimic.make("panda3dof", demonstrations=FEW, **{"world": "nominal", **fields})
    assert isinstance(env, HardwareEnv)
    return env


def with_world(env: HardwareEnv, **world) -> HardwareEnv:
    config = dataclasses.replace(env.config, world=dataclasses.replace(env.world, **world))
    result = make_env(config, env.demonstrations)
    assert isinstance(result, HardwareEnv)
    return result


def roll(env, actions, key: int = 0):
    """States after each action."""
    state, states = env.reset(jax.random.PRNGKey(key)), []
    step = jax.jit(env.step)
    for action in actions:
        state = step(state, action)
        states.append(state)
    return states


@pytest.fixture(scope="module")
def nominal() -> HardwareEnv:
    return make()


@pytest.fixture(scope="module")
def actions(nominal):
    return jax.random.uniform(jax.random.PRNGKey(1), (TICKS, nominal.action_size), minval=-1.0, maxval=1.0)


@pytest.fixture(scope="module")
def undelayed(nominal, actions):
    return roll(nominal, actions)


def test_a_delayed_action_acts_that_many_ticks_later(nominal, actions, undelayed):
    """The first ticks have the action 0, which holds the start pose: the same motion, later."""
    delay = 3
    late = roll(with_world(nominal, action_delay=[delay, delay]), actions)
    start = nominal.start_poses[0]
    np.testing.assert_allclose(late[delay - 1].pipeline_state.reference.qpos, start, atol=1e-6)
    for early, state in zip(undelayed, late[delay:], strict=False):
        np.testing.assert_allclose(state.pipeline_state.qpos, early.pipeline_state.qpos, atol=1e-5)


def test_the_latency_shifts_actions_within_a_tick(nominal, actions, undelayed):
    """The same motion as with five times as many ticks, where each action is repeated, and comes two of them later."""
    world = {**dataclasses.asdict(nominal.world), "action_latency": 0.0}
    fields = {"limits": "hardware", "control": "joint_velocity", "control_dt": 0.01, "horizon": 5 * TICKS}
    short = make(**fields, world=world)
    repeated = jnp.concatenate([jnp.zeros_like(actions[:2]), jnp.repeat(actions, 5, axis=0)])[: 5 * TICKS]
    for at_end, state in zip(roll(short, repeated)[4::5], undelayed, strict=True):
        np.testing.assert_allclose(state.pipeline_state.qpos, at_end.pipeline_state.qpos, atol=1e-5)
        np.testing.assert_allclose(state.pipeline_state.reference.qvel, at_end.pipeline_state.reference.qvel, atol=1e-5)
        assert np.abs(state.pipeline_state.qvel).max() > 0


def test_a_delayed_observation_has_old_measurements_and_new_actions(nominal, actions, undelayed):
    delay = 3
    env = with_world(nominal, observation_delay=[delay, delay])
    late, joints = roll(env, actions), nominal.learner.num_joints
    old, new = undelayed[TICKS - 1 - delay], late[-1]
    expert = [
        env.expert_at(new.pipeline_state.demonstration, jnp.asarray(TICKS + k)) for k in range(env.config.preview + 1)
    ]
    measured = old.pipeline_state.measured[0]
    sent = jnp.concatenate(list(actions[::-1][:3]))
    np.testing.assert_allclose(new.obs, control_observation(env, measured, sent, expert_vector(expert)), atol=1e-5)
    np.testing.assert_allclose(measured[:joints], old.pipeline_state.qpos, atol=1e-7)  # nominal: no noise, no bias
    np.testing.assert_allclose(new.pipeline_state.qpos, undelayed[-1].pipeline_state.qpos, atol=1e-6)


def test_a_history_shows_the_measured_motion_of_past_ticks(nominal, actions, undelayed):
    """As displacements from the present angles and as velocities, the newest first, and as many past actions."""
    past, joints = 4, nominal.learner.num_joints
    state = roll(with_world(nominal, history=past), actions)[-1]
    qpos, qvel = (
        np.stack([getattr(undelayed[TICKS - 2 - k].pipeline_state, name) for k in range(past)])
        for name in ("qpos", "qvel")
    )
    displacement, velocity = np.split(np.asarray(state.obs[-2 * past * joints :]).reshape(2, past, joints), 2)
    np.testing.assert_allclose(displacement[0], qpos - undelayed[-1].pipeline_state.qpos, atol=1e-6)
    np.testing.assert_allclose(velocity[0], qvel, atol=1e-6)
    sent = state.obs[-2 * past * joints - past * nominal.action_size : -2 * past * joints]
    np.testing.assert_allclose(sent.reshape(past, -1), actions[::-1][:past], atol=1e-7)


def test_a_critic_observes_what_was_drawn():
    """Each number from -1 to 1 over its range; 0 where it is constant. The policy observes none of it."""
    env = make(world="unknown")
    states = jax.jit(jax.vmap(env.start))(jax.random.split(jax.random.PRNGKey(0), 200))
    privileged = np.asarray(jax.vmap(env.privileged)(states))
    assert privileged.shape == (200, env.privileged_size) and np.abs(privileged).max() <= 1 + 1e-6
    joints, in_the_paper = env.learner.num_joints, mimic.make("panda3dof", demonstrations=FEW)
    privileged = privileged[:, in_the_paper.privileged_size :]
    payload = privileged[:, joints]
    np.testing.assert_allclose(payload, np.asarray(states.draw.payload) / 1.5 - 1, atol=1e-6)
    is_constant = np.ptp(privileged, axis=0) == 0
    assert np.all(privileged[:, is_constant] == 0) and 0 < is_constant.sum() < is_constant.size - 2 * joints


def test_a_lost_action_is_replaced_by_the_one_before(nominal, actions):
    env = with_world(nominal, packet_loss=0.5)
    arrived, lost = jnp.zeros(env.action_size), 0
    for action, state in zip(actions, roll(env, actions, key=3), strict=True):
        current = state.pipeline_state.arrived[0]
        assert np.allclose(current, action) or np.allclose(current, arrived)
        lost += not np.allclose(current, action)
        arrived = current
    assert 0 < lost < TICKS


def test_what_is_drawn_lies_in_its_ranges_and_changes_the_motion(nominal, actions, undelayed):
    env = make(world="hardware")
    starts = jax.jit(jax.vmap(env.start))(jax.random.split(jax.random.PRNGKey(0), 500))
    draw, world = starts.draw, env.world
    for name, values in {
        "payload": draw.payload, "payload_lever": draw.payload_lever, "gravity_error": draw.gravity_error,
        "link_mass": draw.link_mass, "friction": draw.friction, "motor_gain": draw.gain,
        "observation_delay": draw.observation_delay, "action_delay": draw.action_delay,
    }.items():  # fmt: skip
        low, high = getattr(world, name)
        width = high - low
        assert low <= values.min() < low + 0.05 * width + 1e-9 and high - 0.05 * width - 1e-9 < values.max() <= high
    # An episode starts where the robot measures itself.
    np.testing.assert_allclose(starts.reference.qpos - starts.qpos, draw.bias, atol=1e-6)
    assert 1e-3 < np.abs(draw.bias).max() <= world.position_bias
    assert 0 < np.abs(starts.qpos - env.start_poses[0]).max() <= world.start_noise + 1e-6
    heavy = roll(with_world(nominal, payload=[3.0, 3.0], gravity_error=[0.05, 0.05]), actions)
    difference = np.abs(heavy[-1].pipeline_state.qpos - undelayed[-1].pipeline_state.qpos).max()
    assert 1e-4 < difference < 0.1  # the inner loop holds the arm near its reference


@pytest.mark.slow_for("torque")
@pytest.mark.parametrize("control", ["torque", "joint_velocity"])
def test_each_mode_moves_the_arm_within_its_limits(control):
    env = make(control=control)
    actions = (0.02 if control == "torque" else 0.3) * jnp.ones((TICKS, env.action_size))
    state = roll(env, actions)[-1].pipeline_state
    moved = np.asarray(state.qpos) - env.start_poses[0]
    assert np.all(moved > 0.001)
    lower, upper = np.asarray(env.learner.joint_range).T
    assert np.all((state.qpos > lower) & (state.qpos < upper))


@pytest.mark.slow
def test_mjx_agrees_with_the_fused_loop():
    """With all of the hardware world but contacts, which do not occur here; MJX has MuJoCo's own stops."""
    env = mimic.make("panda4dof", demonstrations=FEW, world="hardware")
    actions = 0.5 * jax.random.uniform(jax.random.PRNGKey(2), (TICKS, env.action_size), minval=-1.0, maxval=1.0)
    fused, mjx = (roll(version, actions, key=5)[-1] for version in (env, env.on_mjx()))
    np.testing.assert_allclose(mjx.pipeline_state.qpos, fused.pipeline_state.qpos, atol=1e-4)
    np.testing.assert_allclose(mjx.obs, fused.obs, atol=1e-3)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"control_dt": 0.0505}, "control_dt: expected a multiple of 0.001 s"),
        (
            {"control_dt": 0.02},
            "world.action_latency: expected a multiple of 0.001 s below control_dt = 0.02 s, got 0.02",
        ),
        ({"observation": {"terms": ["own"]}}, "observation.terms: expected none with an inner loop"),
        (
            {"world": {"expert": "links", "hidden_links": [0, 7]}, "control": "torque"},
            "fewer than the expert's 7 links",
        ),
        ({"control": "velocity"}, "control: expected one of torque, joint_position"),
        ({"learner": "panda_pair", "expert": "panda_pair"}, "expected a serial arm"),
    ],
)
def test_what_does_not_fit_is_rejected(own_registry, fields, message):
    mimic.register("observation_term", "own", lambda env, state: state.qpos)
    with pytest.raises(ValueError, match=message):
        make(**fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"payload": [2.0, 1.0]}, r"world.payload: expected \[minimum, maximum\], got \[2.0, 1.0\]"),
        ({"gravity_error": [0.0, 0.1]}, "world: expected gravity=true with gravity_error or contacts"),
        ({"action_delay": [0, 4]}, "world.action_delay: expected"),
        ({"expert": "hidden"}, "world.expert: expected one of exact, links, points"),
        ({"expert_loss": 0.1}, "world.expert: expected links or points"),
    ],
)
def test_worlds_out_of_range_are_rejected(fields, message):
    with pytest.raises(ValueError, match=message):
        WorldConfig(**fields)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("planar4dof", {"world": "hardware"}),
        (
            "panda4dof",
            {"world": "ideal", "control": "joint_position"},
        ),  # in the zero pose, with joints that rotate without end
        ("panda4dof", {"world": "nominal", "limits": "none", "physics": "mjx"}),
    ],
)
def test_joints_without_limits_have_no_stops(name, fields):
    env = mimic.make(name, demonstrations=FEW, **fields)
    state = roll(env, jnp.full((TICKS, env.action_size), 0.2))[-1]
    assert np.all(np.isfinite(state.obs)) and np.abs(state.pipeline_state.qvel).max() > 1e-3


def test_start_poses_are_within_the_ranges_of_the_inner_loop(nominal):
    """The nearest pose may be at the end of the robot's range; an arm that starts there is rejected by its robot."""
    joints = nominal.learner.num_joints
    lower = nominal.plant.constants.parameters.lower[:joints]
    beyond = np.full((nominal.demonstrations.count, joints), -3.0, np.float32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(imitation, "start_poses", lambda *args: beyond)
        env = make()
    np.testing.assert_allclose(env.start_poses, np.tile(np.maximum(lower, -3.0), (len(beyond), 1)), atol=1e-6)
    assert (env.start_poses > -3.0).any()


def test_the_last_observations_show_the_expert_as_an_exported_controller_does():
    """Demonstrations may be longer than an episode; what comes after it is unknown to both."""
    from mimic.trainers.export.export_controller import expert_table

    env = make(horizon=8)
    short = make_env(dataclasses.replace(env.config, horizon=6), env.demonstrations)
    table = expert_table(short)
    for step in (5, 6):
        states = [short.expert_at(jnp.asarray(0), jnp.asarray(step + k)) for k in range(3)]
        rows = [table[0, min(step + k, 6)] for k in range(3)]
        np.testing.assert_allclose(expert_vector(states), np.concatenate(rows), atol=1e-6)


@pytest.mark.slow
def test_rollouts_start_where_the_episodes_do():
    env = make(world="hardware", horizon=3)
    evaluator = Evaluator(env, env.demonstrations)
    rollouts = jax.jit(lambda: evaluator.rollout(lambda state: jnp.zeros(env.action_size)))()
    deviation = np.abs(np.asarray(rollouts.start) - env.start_poses[0])
    assert 1e-3 < deviation.max() <= env.world.start_noise
    np.testing.assert_allclose(rollouts.qpos[:, 0], rollouts.start, atol=5e-3)  # the action 0 holds the arm
