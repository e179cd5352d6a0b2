"""Our dynamics and both physics against C MuJoCo in double precision, and the GPU kernel, interpreted on the CPU."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.simulation_model import simulation_model
from mimic.base import fused_kernel
from mimic.physics import dynamics
from mimic.physics.joint_numbers import joints_of_model
from mimic.physics.step import PhysicsChoice, choose_physics, make_advance
from tests.helpers.array_cases import acceleration, assert_near
from tests.helpers.lowering import gpu_program
from tests.helpers.random_arms import SEEDS, random_arm
from tests.helpers.trees import torso

ARMS = {
    "panda7": ArmConfig(),
    "panda4": ArmConfig(locked=[3, 6, 7]),
    "panda3": ArmConfig(locked=[2, 3, 6, 7]),
    "panda held": ArmConfig(locked={"joint2": 0.6, "joint4": -1.1}),
    "planar": ArmConfig(model="planar", link_lengths=[0.4, 0.3, 0.2]),
    "panda_pair": ArmConfig(model="panda_pair"),
}


def free_arm(seed):
    """A random arm with armature and damping, without contacts and gravity; the model that simulates it."""
    source = random_arm(seed)
    rng = np.random.default_rng(seed)
    source.dof_armature[:], source.dof_damping[:] = rng.uniform(0, 1e-3, (2, source.nv))
    names = tuple(source.joint(i).name for i in range(source.njnt))
    model = simulation_model(source, names)
    source.opt.disableflags = model.opt.disableflags
    return source, model


def random_states(model, count=4, seed=0):
    """Angles, velocities and torques that accelerate about as fast as the velocities do: each [count, joints]."""
    rng = np.random.default_rng(seed)
    qpos = rng.uniform(-np.pi, np.pi, (count, model.nq))
    qvel, qacc = 3 * rng.normal(size=(2, count, model.nv))
    torque = np.empty_like(qpos)
    data = mujoco.MjData(model)
    for row, state in zip(torque, zip(qpos, qvel, qacc, strict=True), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mujoco.mj_inverse(model, data)
        row[:] = data.qfrc_inverse
    return qpos, qvel, torque


def mujoco_acceleration(model, qpos, qvel, torque):
    return np.array([acceleration(model, *row) for row in zip(qpos, qvel, torque, strict=True)])


def ours(function, model, *rows):
    """A function of `dynamics` on arrays [count, joints]."""
    columns = ([jnp.asarray(column) for column in row.T] for row in rows)
    return np.stack(function(joints_of_model(model), *columns), axis=-1)


def original_and_simulated(name):
    """A model without gravity, and the one that simulates its arm; they differ for a random arm, given by its seed."""
    if isinstance(name, int):
        return free_arm(name)
    if name == "torso":
        source = mujoco.MjModel.from_xml_string(torso(2))
        model = simulation_model(source, tuple(source.joint(i).name for i in range(source.njnt)))
    else:
        model = build_arm(ARMS[name]).model
    return model, model


@pytest.mark.parametrize("name", [*ARMS, "torso", *SEEDS])
def test_forward_and_inverse_dynamics_equal_those_of_mujoco(x64, name):
    """Against the original model, so that `simulation_model` is tested too, with its reference angles."""
    source, model = original_and_simulated(name)
    np.testing.assert_array_equal(model.qpos0, source.qpos0)
    qpos, qvel, torque = random_states(source)
    qacc = mujoco_acceleration(source, qpos, qvel, torque)
    assert_near(ours(dynamics.acceleration, model, qpos, qvel, torque), qacc)
    assert_near(ours(dynamics.inverse, model, qpos, qvel, qacc), torque)  # `torque` is of mj_inverse


def test_random_arms_include_the_hard_cases():
    sources = [random_arm(seed) for seed in SEEDS]
    assert any(source.body_jntnum.max() == 2 for source in sources)
    assert any(source.qpos0.any() for source in sources)
    assert all(source.jnt_pos.any() for source in sources)


def test_auto_is_fused_for_every_model_that_simulates_an_arm():
    for name in (*ARMS, "torso", *SEEDS[:5]):
        _, model = original_and_simulated(name)
        assert choose_physics("auto", model) == PhysicsChoice("fused", "auto: it covers the learner exactly")


def with_option(**values):
    model = build_arm(ARMS["planar"]).model
    for name, value in values.items():
        setattr(model.opt, name, value)
    return model


def with_field(name):
    model = build_arm(ARMS["planar"]).model
    getattr(model, name)[:] = 1
    return model


def from_xml(bodies, rest=""):
    option = '<option integrator="RK4" gravity="0 0 0"/>'
    inertial = '<inertial pos="0.1 0 0" mass="1" diaginertia="1 1 1"/>'
    return mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<worldbody>{bodies.replace('+', inertial)}</worldbody>{rest}</mujoco>"
    )


_TWO = '<body>+<joint name="a"/>{}<body pos="1 0 0">+<joint name="b" {}/></body></body>'
UNCOVERED = {
    "gravity": lambda: with_option(disableflags=0),
    "springs": lambda: with_field("jnt_stiffness"),
    "dry friction": lambda: with_field("dof_frictionloss"),
    "joint limits": lambda: with_field("jnt_limited"),
    "a fluid": lambda: with_option(viscosity=1.0),
    "another integrator": lambda: with_option(integrator=mujoco.mjtIntegrator.mjINT_EULER),
    "joints that are not revolute": lambda: from_xml(_TWO.format("", 'type="slide"')),
    "bodies that no joint moves": lambda: from_xml(_TWO.format('<body pos="0 1 0">+</body>', "")),
    "contacts": lambda: from_xml(_TWO.format('<geom size="0.1"/>', "")),
    "constraints": lambda: from_xml(
        _TWO.format("", ""), '<equality><joint joint1="a" joint2="b"/></equality>'
    ),
    "actuators": lambda: from_xml(_TWO.format("", ""), '<actuator><motor joint="a"/></actuator>'),
    "tendons": lambda: from_xml(
        _TWO.format("", ""), '<tendon><fixed stiffness="1"><joint joint="a" coef="1"/></fixed></tendon>'
    ),
}  # fmt: skip


@pytest.mark.parametrize("element", UNCOVERED)
def test_auto_is_mjx_where_the_fused_dynamics_lack_something(element):
    model = UNCOVERED[element]()
    choice = choose_physics("auto", model)
    assert choice == PhysicsChoice("mjx", f"auto: the fused dynamics do not cover {element}")
    assert choose_physics("fused", model).name == "fused"  # what is configured is used


def test_auto_is_mjx_for_many_joints():
    """The fused dynamics of 24 joints compile in 45 s of a core; MJX compiles as long, and runs faster."""
    for joints, expected in ((16, "fused"), (17, "mjx")):
        model = build_arm(ArmConfig(model="planar", link_lengths=[0.1] * joints)).model
        assert choose_physics("auto", model).name == expected


def locked_panda(locked):
    arm = build_arm(ArmConfig(locked=locked))
    return build_arm(ArmConfig()).model, arm.model, dict(arm.locked)


def locked_random_arm(seed):
    """Every other joint is locked, the first one included."""
    source, _ = free_arm(seed)
    angles = {source.joint(i).name: 0.3 * (i + 1) for i in range(0, source.njnt, 2)}
    names = tuple(source.joint(i).name for i in range(1, source.njnt, 2))
    return source, simulation_model(source, names, angles), angles


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (locked_panda, (3, 6, 7)),
        (locked_panda, {"joint3": 0.4, "joint1": -0.3}),
        # 5, 8 and 9 joints; in 17 one body has a free joint and then a locked one
        *((locked_random_arm, seed) for seed in (4, 7, 17)),
    ],
)
def test_locked_arms_accelerate_as_the_whole_arm_with_joints_held(x64, make, argument):
    source, model, angles = make(argument)
    locked = [source.joint(name).id for name in angles]
    free = [joint for joint in range(source.njnt) if joint not in locked]
    qpos, qvel, torque = random_states(model)
    data, expected = mujoco.MjData(source), []
    data.qpos[locked] = list(angles.values())
    for data.qpos[free], data.qvel[free], applied in zip(qpos, qvel, torque, strict=True):
        mujoco.mj_forward(source, data)
        columns = np.zeros((len(free), source.nv))
        for column, joint in zip(columns, free, strict=True):
            mujoco.mj_mulM(source, data, column, np.eye(source.nv)[joint])
        forces = applied + (data.qfrc_passive - data.qfrc_bias)[free]
        expected.append(np.linalg.solve(columns[:, free], forces))
    assert_near(ours(dynamics.acceleration, model, qpos, qvel, torque), np.array(expected))


@pytest.mark.parametrize("kind", ["mjx", "fused"])
def test_both_physics_step_as_mujoco_does(x64, kind):
    """Three steps of RK4 in double precision: the same formula, in another order."""
    model, timestep, substeps = build_arm(ARMS["planar"]).model, 0.01, 3
    model.opt.timestep = timestep
    qpos, qvel, torque = random_states(model)
    advance = make_advance(model, timestep, substeps, kind)
    state, empty = tuple(map(jnp.asarray, (qpos, qvel, torque))), np.zeros((0, 3), np.float32)
    steps = jax.jit(jax.vmap(advance))
    actual = steps(*state)
    data, expected = mujoco.MjData(model), []
    for data.qpos[:], data.qvel[:], data.qfrc_applied[:] in zip(qpos, qvel, torque, strict=True):
        mujoco.mj_step(model, data, substeps)
        expected.append((data.qpos.copy(), data.qvel.copy()))
    for values, reference in zip(actual, np.swapaxes(expected, 0, 1), strict=True):
        assert_near(np.asarray(values), reference)
    # With an empty array jaxlib 0.11.2 crashes on a function for several devices; 0.10.2 and 0.12.0 do not.
    programs = steps, jax.jit(lambda qpos, *_: jnp.sum(qpos[0, 0] * empty))
    assert ["constant dense<>" in program.lower(*state).as_text() for program in programs] == [False, True]


@pytest.fixture(scope="module")
def planar():
    """A small arm that compiles quickly, with 5 states."""
    model = build_arm(ARMS["planar"]).model
    return model, [jnp.asarray(x, jnp.float32) for x in random_states(model, count=5)]


def test_a_batch_steps_as_each_of_its_arms(planar):
    model, states = planar
    advance = make_advance(model, 0.01, 2, "fused")
    together = jax.jit(jax.vmap(advance))(*states)
    alone = jax.jit(advance)
    for i in range(5):
        one = alone(*(x[i] for x in states))
        for batched, single in zip(together, one, strict=True):
            np.testing.assert_allclose(batched[i], single, atol=1e-5)  # rounding of velocities up to 10 rad/s


def test_the_kernel_steps_as_the_plain_function_does(planar, gpu_kernels):
    """The GPU kernel, interpreted on the CPU, for a batch that is no multiple of its block."""
    count = fused_kernel.DEFAULT.block + 1
    model, states = planar
    advance = make_advance(model, 0.01, 2, "fused")
    rows = [jnp.resize(x, (count, *x.shape[1:])) for x in states]
    batch = jax.jit(jax.vmap(advance))(*rows)
    assert len(gpu_kernels) == 1
    alone = jax.jit(advance)
    expected = [alone(*(x[i] for x in states)) for i in range(5)]
    for index, values in enumerate(batch):
        reference = np.stack([one[index] for one in expected])
        np.testing.assert_allclose(values, np.resize(reference, (count, 3)), atol=1e-5)  # as above


def test_the_kernel_lowers_without_a_gpu(planar):
    model, states = planar
    advance = make_advance(model, 0.01, 2, "fused")
    batched = jax.jit(jax.vmap(advance))
    assert "triton" in gpu_program(batched, *states)
    assert "triton" not in batched.lower(*states).as_text()


@pytest.mark.slow
def test_default_substeps_keep_the_tip_within_1_mm():
    """1 s of random torques against RK4 at 0.5 ms; 0.2 mm when written, a thousandth of the reach is 1 mm."""
    env = mimic.make("panda4dof", physics="fused", demonstrations={"count": 1, "held_out": 1})
    arm, model, substeps, dt = env.learner, env.arm.model, env.config.substeps, env.config.control_dt
    torques = np.random.default_rng(0).uniform(-1, 1, (4, 10, model.nv)) * np.asarray(env.torque_scale)
    advance = make_advance(model, dt / substeps, substeps, "fused")
    home = jnp.asarray(arm.home, jnp.float32)

    @jax.jit
    @jax.vmap
    def final(held):
        def step(state, torque):
            qpos, qvel = state
            return advance(qpos, qvel, torque), None

        return jax.lax.scan(step, (home, jnp.zeros_like(home)), held)[0][0]

    @jax.jit
    @jax.vmap
    def tip(qpos):
        frames = mimic.forward_kinematics(arm, qpos)
        return frames.position[-1] + arm.link_lengths[-1] / 2 * frames.rotation[-1, :, 0]

    fine = model.__copy__()
    fine.opt.timestep = 5e-4
    expected = []
    for sequence in torques:
        data = mujoco.MjData(fine)
        data.qpos[:] = arm.home
        for data.qfrc_applied[:] in sequence:
            mujoco.mj_step(fine, data, round(dt / fine.opt.timestep))
        expected.append(data.qpos.copy())
    apart = tip(final(jnp.asarray(torques, jnp.float32))) - tip(jnp.asarray(expected, jnp.float32))
    assert np.linalg.norm(apart, axis=-1).max() < 1e-3
