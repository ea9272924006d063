"""Warning about a primitive whose motion without actions deviates from the demonstrations."""

from guiderail.tools.environments import warn_of_deviation


def test_strong_regularization_causes_a_warning():
    assert warn_of_deviation("NarrowPassage", {}) is None
    warning = warn_of_deviation("NarrowPassage", {"lambda_": 1e4, "beta": 1e4})
    assert warning.startswith("without actions, ")
    assert "dataset validate FILE --fit" in warning


def test_task_without_demonstrations_causes_no_warning():
    assert warn_of_deviation("Pouring", {}) is None


def test_long_length_scale_causes_a_warning():
    assert "standard deviation" in warn_of_deviation("NarrowPassage", {"length_scale": 50.0})
