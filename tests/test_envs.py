"""The environment, its physics and its demonstrations."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.simulation_model import effective_inertia, simulation_model
from mimic.envs.config import PHYSICS
from mimic.envs.imitation import training_and_held_out
from mimic.envs.physics import Load, make_advance
from mimic.envs.wrappers import wrap_for_training

DT = 0.1
FEW = {"count": 6, "held_out": 2}


@pytest.fixture(scope="module")
def planar_env():
    return mimic.make("planar4dof", demonstrations=FEW)


@pytest.fixture(scope="module")
def panda_scale():
    """Largest torques."""
    return np.asarray(mimic.make("panda7dof", demonstrations={"count": 1, "held_out": 1}).torque_scale)


@pytest.mark.parametrize("load", [Load(), Load(mass=1.2, damping=3.0)])
@pytest.mark.parametrize("physics", PHYSICS)
def test_the_panda_moves_as_in_mujoco(panda_scale, physics, load):
    """1 s of random torques at the default step: 1e-4 rad, what ten control steps leave of float32."""
    model = build_arm(ArmConfig()).model
    substeps = mimic.env_config("panda7dof").substeps
    model.opt.timestep = DT / substeps
    torques = np.random.default_rng(0).uniform(-1, 1, (10, 7)) * panda_scale
    advance = jax.jit(make_advance(model, DT / substeps, substeps, physics))
    model.body_mass *= load.mass
    model.body_inertia *= load.mass
    model.dof_damping *= load.damping
    data = mujoco.MjData(model)
    qpos, qvel = jnp.zeros(7), jnp.zeros(7)
    for torque in torques:
        data.qfrc_applied[:] = torque
        mujoco.mj_step(model, data, substeps)
        qpos, qvel = advance(qpos, qvel, jnp.asarray(torque, jnp.float32), load)
        np.testing.assert_allclose(qpos, data.qpos, atol=1e-4)


@pytest.mark.parametrize("locked", [(3, 6, 7), {"joint3": 0.4, "joint1": -0.3}])
def test_locked_model_has_the_dynamics_of_the_held_arm(locked):
    arm = build_arm(ArmConfig(locked=locked))
    full = build_arm(ArmConfig())
    model, names = arm.model, arm.embodiment.joint_names
    index = [full.embodiment.joint_names.index(name) for name in names]
    rng = np.random.default_rng(1)
    data, full_data = mujoco.MjData(model), mujoco.MjData(full.model)
    data.qpos[:], data.qvel[:] = rng.normal(size=model.nq), rng.normal(size=model.nq)
    if isinstance(locked, dict):
        for name, angle in locked.items():
            full_data.qpos[full.embodiment.joint_names.index(name)] = angle
    full_data.qpos[index], full_data.qvel[index] = data.qpos, data.qvel
    for one, other in ((model, data), (full.model, full_data)):
        mujoco.mj_forward(one, other)
    np.testing.assert_allclose(data.qfrc_bias, full_data.qfrc_bias[index], atol=1e-12)
    vector, product, full_product = rng.normal(size=model.nv), np.zeros(model.nv), np.zeros(7)
    padded = np.zeros(7)
    padded[index] = vector
    mujoco.mj_mulM(model, data, product, vector)
    mujoco.mj_mulM(full.model, full_data, full_product, padded)
    np.testing.assert_allclose(product, full_product[index], atol=1e-12)


def test_simulation_model_keeps_only_what_moves():
    model = build_arm(ArmConfig(locked=(3, 6, 7))).model
    assert (model.nq, model.nu, model.ngeom, model.nsite) == (4, 0, 0, 0)
    assert simulation_model(model, ()).nq == 0
    assert np.all(effective_inertia(model, np.zeros(4)) > 0)


QUICK = ("planar4dof", "panda3dof")  # the others have all their shapes checked


@pytest.mark.parametrize("name", mimic.environments())
def test_every_environment_has_its_shapes(name):
    env = mimic.make(name, demonstrations=FEW, physics="fused")
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    assert state.obs.shape == (env.observation_size,)
    after = jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)


@pytest.mark.parametrize("limits", ["none", "hardware"])
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in mimic.environments()]
)
def test_every_environment_resets_and_steps(name, limits):
    # MJX takes longest to compile; other tests hold each arm's motion under it against MuJoCo's.
    physics = "mjx" if name == "planar4dof" and limits == "none" else "fused"
    env = mimic.make(name, demonstrations=FEW, limits=limits, physics=physics)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    after = jax.jit(env.step)(state, jnp.zeros(env.action_size))
    assert after.reward == pytest.approx(-float(after.metrics["distance"]))  # at rest at home, far from any limit
    assert np.all(np.isfinite(after.obs)) and not after.done


def test_episodes_end_at_the_horizon_and_draw_fresh_demonstrations(planar_env):
    env = wrap_for_training(planar_env, planar_env.config.horizon + 1)
    count, horizon = 32, planar_env.config.horizon

    @jax.jit
    def rollout(state):
        def step(state, _):
            state = env.step(state, jnp.zeros((count, planar_env.action_size)))
            arm = state.pipeline_state
            return state, (state.done, state.info["truncation"], arm.demonstration, arm.step)

        return jax.lax.scan(step, state, None, length=3 * horizon)[1]

    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), count))
    assert len(np.unique(state.pipeline_state.step)) > 10  # the first episodes are out of step with each other
    done, truncation, demonstration, step = map(np.asarray, rollout(state))
    assert np.all(done.sum(axis=0) == 3)
    assert not truncation.any()
    assert np.all(step[done.astype(bool)] == 0)
    assert all(len(np.unique(demonstration[:, i])) > 1 for i in range(count) if i % 8 == 0)


def test_a_runaway_ends_the_episode_and_never_pays(planar_env):
    state = planar_env.reset(jax.random.PRNGKey(0))
    fast = state.pipeline_state.replace(qvel=jnp.full(4, 100.0))
    after = jax.jit(planar_env.step)(state.replace(pipeline_state=fast), jnp.zeros(4))
    assert after.done == 1 and after.metrics["runaway"] == 1
    worst_rest = -planar_env.config.horizon * float(after.metrics["distance"])
    assert after.reward == pytest.approx(worst_rest, rel=1e-5)


def test_hardware_limits_cost_where_they_are_near_and_beyond():
    free, limited = (
        mimic.make("panda4dof", physics="fused", demonstrations=FEW, limits=limits, limit_weight=2.0)
        for limits in ("none", "hardware")
    )
    home, still = jnp.asarray(limited.learner.home, jnp.float32), jnp.zeros(4)
    upper, rated = limited.learner.joint_range[:, 1], limited.learner.velocity_limit
    assert limited.limit_excess(home, still) == 0
    beyond = limited.limit_excess(home.at[0].set(upper[0] + 0.02), still)
    assert beyond == pytest.approx(0.5 * (0.02 + 0.03) / 0.1 / 4, rel=1e-3)  # 3e-7 of an angle, over 0.05
    assert limited.limit_excess(home.at[0].set(upper[0] + 9.0), still) == pytest.approx(0.5 / 4)
    assert limited.limit_excess(home, still.at[1].set(-1.5 * rated[1])) == pytest.approx(0.5 / 4)
    for env, weight in ((free, 0.0), (limited, 2.0)):
        state = env.reset(jax.random.PRNGKey(0))
        arm = state.pipeline_state.replace(qvel=still.at[1].set(1.2 * rated[1]))
        after = jax.jit(env.step)(state.replace(pipeline_state=arm), still)
        costs = after.metrics["distance"] + weight * after.metrics["limit_excess"]
        assert after.metrics["limit_excess"] > 0
        assert after.reward == pytest.approx(-float(costs), rel=1e-6)


def test_demonstrations_are_reproducible_and_within_limits():
    arm = build_arm(ArmConfig(), "hardware")
    few, more = (mimic.record_demonstrations(arm, count, seed=3) for count in (2, 3))
    np.testing.assert_array_equal(few.qpos, more.qpos[:2])
    lower, upper = arm.embodiment.joint_range.T
    assert np.all((more.qpos >= lower) & (more.qpos <= upper))
    assert np.all(np.abs(more.qvel) <= arm.embodiment.velocity_limit)
    assert np.all(more.qvel[:, 0] == 0)


@pytest.mark.parametrize("limits", ["none", "hardware"])
def test_reaches_end_where_they_should_and_within_limits(limits):
    arm = build_arm(ArmConfig(), limits)
    reaches = mimic.record_demonstrations(arm, 4, kind="reach", seed=1)
    embodiment = arm.embodiment
    assert np.all(np.abs(reaches.qvel) <= embodiment.velocity_limit)
    hand = jax.vmap(lambda qpos: mimic.forward_kinematics(embodiment, qpos).position[-1])
    np.testing.assert_allclose(hand(reaches.qpos[:, -1]), hand(reaches.goals), atol=5e-3)  # 5 mm: feedback, not fit
    other = mimic.record_demonstrations(arm, 4, kind="pd", seed=1)
    assert not np.allclose(other.qpos, reaches.qpos, atol=0.1)


def test_training_and_held_out_are_apart():
    training, held_out = training_and_held_out(mimic.env_config("planar4dof", demonstrations=FEW))
    assert (training.count, held_out.count) == (6, 2)
    assert not np.isin(held_out.goals, training.goals).any()


@pytest.fixture
def saved(tmp_path):
    arm = build_arm(ArmConfig(model="planar", link_lengths=[0.5, 0.5]))
    demonstrations = mimic.record_demonstrations(arm, 2, horizon=5)
    path = tmp_path / "demonstrations.npz"
    demonstrations.save(path)
    return demonstrations, path


def test_demonstrations_survive_a_file(saved):
    demonstrations, path = saved
    loaded = mimic.load_demonstrations(path)
    np.testing.assert_array_equal(loaded.qpos, demonstrations.qpos)
    assert (loaded.joint_names, loaded.dt, loaded.seed) == (demonstrations.joint_names, 0.1, 0)


def _with_array(path):
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def _rewritten(path, **changes):
    with np.load(path) as archive:
        content = {key: archive[key] for key in archive.files}
    np.savez(path, **{**content, **changes})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "no file"),
        (lambda path: path.write_bytes(path.read_bytes()[:300]), "not a whole npz"),
        (lambda path: path.write_text("hello"), "not a whole npz"),
        (lambda path: _with_array(path), "it holds a single array"),
        (lambda path: _rewritten(path, seed=np.arange(2)), "seed"),
        (lambda path: _rewritten(path, arm=np.array(["a", "b"])), "arm"),
        (lambda path: _rewritten(path, goals=np.array([{}, None], dtype=object)), "pickled objects"),
        (lambda path: _rewritten(path, qpos=np.full((2, 6, 2), np.nan)), "not finite"),
        (lambda path: _rewritten(path, qpos=np.zeros((2, 6, 3))), "qpos"),
        (lambda path: _rewritten(path, dt=np.array(-1.0)), "dt"),
    ],
)
def test_bad_demonstration_files_are_refused_in_one_line(saved, damage, message):
    _, path = saved
    damage(path)
    with pytest.raises(ValueError, match=message) as error:
        mimic.load_demonstrations(path)
    assert "\n" not in str(error.value)


def test_demonstrations_of_another_arm_or_time_step_are_refused(saved):
    demonstrations, path = saved
    with pytest.raises(ValueError, match="joints"):
        mimic.make("panda4dof", demonstrations={"path": str(path), "count": 1, "held_out": 1})
    with pytest.raises(ValueError, match="time step"):
        demonstrations.check_fits(mimic.planar_arm([0.5, 0.5]), 0.05, 5)
    with pytest.raises(ValueError, match="steps long"):
        demonstrations.check_fits(mimic.planar_arm([0.5, 0.5]), 0.1, 50)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"previw": 1}, "unknown key 'previw'; valid are"),
        ({"preview": "x"}, "could not be converted to Integer"),
        ({"demonstrations": {"cont": 1}}, "unknown key 'demonstrations.cont'"),
        ({"limits": "soft"}, "expected one of none, hardware"),
        ({"demonstrations": {"kind": "dance"}}, "expected one of pd, reach"),
        ({"metric": {"xi": 1.0}}, "below 0"),
        ({"metric": {"xi": float("-inf")}}, "finite number below 0"),
        ({"learner": {"locked": [1, 2, 3, 4, 5, 6, 7]}}, "all 7 joints are locked"),
        ({"learner": {"locked": [9]}}, "unknown joint 9"),
    ],
)
def test_bad_overrides_are_refused(overrides, message):
    with pytest.raises(ValueError, match=message):
        mimic.make("panda4dof", **overrides)


def test_unknown_environment_names_the_known():
    with pytest.raises(ValueError, match="panda3dof, panda4dof, panda7dof, planar4dof"):
        mimic.make("panda5dof")
