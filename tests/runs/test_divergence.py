"""The check that ends a training whose numbers are not finite."""

import numpy as np
import pytest

from mimic.runs.divergence import Diverged, check_finite

PARAMS = {"hidden": {"kernel": np.ones((2, 3)), "bias": np.zeros(3)}}


def test_finite_numbers_pass():
    check_finite(100, {"loss": 1e30, "entropy": -2.0}, PARAMS)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_metric_that_is_not_finite_is_named(value):
    with pytest.raises(Diverged, match=r"^training diverged: loss is not finite after 100 steps$") as error:
        check_finite(100, {"entropy": 1.0, "loss": value}, PARAMS)
    assert error.value.step == 100


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_parameter_that_is_not_finite_is_named(value):
    params = {"hidden": {**PARAMS["hidden"], "bias": np.array([0.0, value, 0.0])}}
    with pytest.raises(Diverged, match=r"parameter hidden\.bias is not finite after 100 steps$"):
        check_finite(100, {"loss": 1.0}, params)
