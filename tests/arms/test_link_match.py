"""Colours of corresponding links, and the ghost of an expert over its learner."""

import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.link_match import THRESHOLD, colours_along_arm, link_ends
from mimic.arms.visual_model import HAND_LINE, body_links, is_dark, visual_spec
from mimic.metric.config import MetricConfig
from mimic.metric.kinematics import link_states

EXPERT, LEARNER = mimic.planar_arm([0.25] * 4), mimic.planar_arm([0.8, 1.2])
MATCH = MetricConfig().match_links(EXPERT, LEARNER)


def test_a_link_has_the_mean_colour_of_the_links_that_it_corresponds_to():
    """The learner's first link, 40 % of its length, covers the first expert link and 3/5 of the second."""
    first, second = colours_along_arm(4)[:2]
    expected = (0.25 * first + 0.15 * second) / 0.4
    np.testing.assert_allclose(MATCH.learner_colours["link1"], expected, atol=1e-6)
    equal = MetricConfig().match_links(EXPERT, EXPERT)
    for link, colour in equal.expert_colours.items():
        assert equal.learner_colours[link] == pytest.approx(colour)


@pytest.mark.parametrize("links", ["kept", "merged"])
def test_ends_of_links_are_those_of_the_kinematics(links):
    arm = mimic.panda(locked=(3, 6), links=links)
    qpos = np.linspace(-1, 1, arm.num_joints)
    ends, states = link_ends(arm, qpos), link_states(arm, qpos)
    middle = np.asarray(states.position) * float(arm.chain_length)
    np.testing.assert_allclose(ends.mean(axis=1), middle, atol=1e-6)  # m; float32
    along = np.diff(ends, axis=1)[:, 0] / np.asarray(arm.link_lengths)[:, None]
    np.testing.assert_allclose(along, np.asarray(states.direction), atol=1e-6)


def test_a_ghost_is_the_expert_at_the_learners_length_with_lines_between_links():
    qpos = np.array([0.4, 0.3, -0.2, 0.1])
    capsules = MATCH.ghost(qpos, np.zeros(2))
    np.testing.assert_allclose(capsules[3].end, 2 * link_ends(EXPERT, qpos)[3, 1])  # lengths 1 and 2
    assert len(capsules) == 4 + np.sum(MATCH.fractions >= THRESHOLD)
    assert all(capsule.rgba[3] < 0.5 for capsule in capsules[:4])


def test_visible_parts_of_a_link_have_its_colour():
    config = ArmConfig(locked=[3, 6, 7])
    arm = build_arm(config).embodiment
    colours = MetricConfig().match_links(arm, arm).expert_colours
    spec, _ = visual_spec(config, "none", colours)
    model = spec.compile()
    links = body_links(model, config, "none")
    assert set(links.values()) == set(colours)
    for body, link in links.items():
        geoms = [geom for geom in range(model.ngeom) if not model.geom(geom).name.startswith(HAND_LINE)]
        rgba = [model.geom_rgba[geom] for geom in geoms if model.geom_bodyid[geom] == body]
        light = [colour for colour in rgba if not is_dark(colour)] or rgba
        np.testing.assert_allclose(light, [(*colours[link], 1.0)] * len(light), atol=1e-6)


def test_bodies_without_names_have_colours_of_their_own(tmp_path):
    body = '<body pos="{}"><joint axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 .3" rgba="1 1 1 1"/>'
    path = tmp_path / "arm.xml"
    bodies = body.format("0 0 0") + body.format("0 0 .3") + "</body></body>"
    path.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    config = ArmConfig(model=str(path))
    arm = build_arm(config).embodiment
    model = visual_spec(config, "none", MetricConfig().match_links(arm, arm).expert_colours)[0].compile()
    colours = [
        model.geom_rgba[geom] for geom in range(model.ngeom) if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE
    ]
    assert not np.allclose(colours[0], colours[-1])
