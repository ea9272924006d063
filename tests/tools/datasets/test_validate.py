"""Tests of the warning about a primitive whose motion without actions leaves the demonstrations."""

import pytest

from guiderail.tools.datasets.validate import warn_of_deviation


def test_strong_regularization_is_warned_about_with_a_remedy():
    assert warn_of_deviation("NarrowPassage", {}) is None
    warning = warn_of_deviation("NarrowPassage", {"lambda_": 1e4, "beta": 1e4})
    assert warning.startswith("without actions, ")
    assert "dataset validate FILE --fit" in warning


def test_no_warning_for_a_task_without_demonstrations():
    assert warn_of_deviation("Pouring", {}) is None


@pytest.mark.parametrize("length_scale", [50.0])
def test_long_length_scale_is_warned_about(length_scale):
    assert "standard deviation" in warn_of_deviation("NarrowPassage", {"length_scale": length_scale})
