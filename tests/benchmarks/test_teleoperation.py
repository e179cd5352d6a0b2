"""The benchmark of live teleoperation sees violations, and its faults cause none."""

import numpy as np

import mimic
from benchmarks.teleoperation import faulty, ratios, wander

RATE = 100.0


def test_violations_are_seen():
    operator = mimic.Teleoperator(mimic.panda(limits="hardware"), mimic.panda(limits="hardware"), rate=RATE)
    still = np.tile(operator.follower.home, (10, 1))
    assert ratios(still, operator, RATE)[2] == 0
    step = still + 0.1 * (np.arange(10) == 5)[:, None]
    largest, beyond, count = ratios(step, operator, RATE)
    assert largest > 1 and beyond < 0 and count > 0
    assert ratios(still + 4 * np.eye(7)[0], operator, RATE)[1] > 1000  # mrad beyond the range


def test_faults_cause_no_violation():
    leader, rng = mimic.panda(limits="hardware"), np.random.default_rng(0)
    operator = mimic.Teleoperator(leader, mimic.panda(limits="hardware", locked=[3]), rate=RATE)
    operator.engage()
    path, recoveries, holding = faulty(operator, wander(leader, 850, rng), rng)
    assert np.all(np.isfinite(path)) and ratios(path, operator, RATE)[2] == 0
    assert len(recoveries) == 3 and max(recoveries) <= 0.5 and 0 < holding < 850
