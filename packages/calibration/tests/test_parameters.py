import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import check_environment
from guiderail_calibration.parameters import PARAMETERS, options_of, select_parameters

CONNECTOR = {"station": "gantry", "sensing": "robot"}


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda parameter: parameter.name)
def test_values_are_monotone_and_span_the_prior(parameter):
    values = parameter.value(np.linspace(0.0, 1.0, 101))
    assert (np.diff(values) >= 0.0).all()
    assert (values[0], values[-1]) == pytest.approx((parameter.low, parameter.high))


def test_integer_values_are_equally_likely():
    parameter = next(parameter for parameter in PARAMETERS if parameter.scale == "integer")
    _, counts = np.unique(parameter.value(np.linspace(0.0, 1.0, 8000, endpoint=False)), return_counts=True)
    assert len(counts) == parameter.high - parameter.low + 1
    assert np.ptp(counts) <= 1


def test_every_draw_is_a_valid_environment():
    parameters, left_out = select_parameters("BncConnector", CONNECTOR)
    assert left_out["payload"] == left_out["joint_friction"] == "only an arm has it"
    assert "damping" in left_out
    on_arm, _ = select_parameters("BncConnector", {"station": "arm"})
    assert {"payload", "joint_friction"} <= {parameter.name for parameter in on_arm}
    for quantiles in np.random.default_rng(0).uniform(size=(20, len(parameters))):
        changes = options_of("BncConnector", CONNECTOR, parameters, quantiles)
        check_environment("BncConnector", {**CONNECTOR, **changes})


@pytest.mark.parametrize(("names", "message"), [(["frictoin"], "did you mean friction"), (["payload"], "only an arm")])
def test_unknown_or_absent_parameter_is_refused(names, message):
    with pytest.raises(InputError, match=message):
        select_parameters("BncConnector", CONNECTOR, names)
