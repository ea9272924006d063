"""A primitive whose zero action leaves what was demonstrated says so before anything is learned from it."""

import pytest

from guiderail.tools.datasets.validate import leaves_demonstrations


def test_a_regularization_that_pulls_everything_to_zero_is_said_with_a_remedy():
    assert leaves_demonstrations("NarrowPassage", {}) is None
    said = leaves_demonstrations("NarrowPassage", {"lambda_": 1e4, "beta": 1e4})
    assert said.startswith("without actions, ")
    assert "dataset validate FILE --fit" in said


def test_a_task_without_demonstrations_has_nothing_to_leave():
    assert leaves_demonstrations("Pouring", {}) is None


@pytest.mark.parametrize("length_scale", [50.0])
def test_a_kernel_that_cuts_all_corners_is_said(length_scale):
    assert "standard deviation" in leaves_demonstrations("NarrowPassage", {"length_scale": length_scale})
