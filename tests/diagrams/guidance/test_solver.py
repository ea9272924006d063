"""Option `solver` of the constrained primitive: equal commands and refused names."""

import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.models.common.errors import InputError
from guiderail.tools.cli.app import parse_environment
from guiderail.tools.environments import check_environment


def commands(**options):
    """Return commands and violations [m] of 12 actions towards the zone, where the constraint is active."""
    env = make_env("NarrowPassage", guidance="skgrl", action_scale=3.0, **options)
    env.reset(seed=0)
    violations = []
    for _ in range(12):
        info = env.step(np.array([1.0, 0.0]))[-1]
        violations.append(info["constraint_violation"])
    path = np.array(env.trace.commanded)
    env.close()
    return path, np.array(violations)


def test_solvers_return_equal_commands_within_the_constraint():
    expected, violations = commands()
    assert violations.max() > -1e-6, "the constraint is not active"
    for solver in ("osqp", "piqp"):
        path, violations = commands(solver=solver)
        np.testing.assert_allclose(path, expected, atol=1e-5)
        assert violations.max() <= 1e-9


def test_solver_option_is_parsed_or_refused_when_unknown():
    assert check_environment("BncConnector", parse_environment(["solver=osqp"]))["solver"] == "osqp"
    with pytest.raises(InputError, match="there is no solver 'osq': did you mean osqp"):
        check_environment("NarrowPassage", parse_environment(["solver=osq"]))
