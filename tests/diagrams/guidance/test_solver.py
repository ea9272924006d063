"""The solver of the constrained primitive is an option of the environment, and of no consequence but its time."""

import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.models.common.errors import InputError
from guiderail.tools.cli.app import parse_environment
from guiderail.tools.environments import check_environment


def commands(**options):
    """Return commands and violations for actions towards the zone, where the constraint is active."""
    env = make_env("NarrowPassage", guidance="skgrl", action_scale=3.0, **options)
    env.reset(seed=0)
    violations = []
    for _ in range(12):
        info = env.step(np.array([1.0, 0.0]))[-1]
        violations.append(info["constraint_violation"])
    path = np.array(env.trace.commanded)
    env.close()
    return path, np.array(violations)


def test_every_solver_commands_the_same_and_keeps_the_constraint():
    expected, violations = commands()
    assert violations.max() > -1e-6, "the constraint is met"
    for solver in ("osqp", "piqp"):
        path, violations = commands(solver=solver)
        np.testing.assert_allclose(path, expected, atol=1e-5)
        assert violations.max() <= 1e-9


def test_solver_option_is_parsed_and_unknown_ones_refused():
    assert check_environment("BncConnector", parse_environment(["solver=osqp"]))["solver"] == "osqp"
    with pytest.raises(InputError, match="there is no solver 'osq': did you mean osqp"):
        check_environment("NarrowPassage", parse_environment(["solver=osq"]))
