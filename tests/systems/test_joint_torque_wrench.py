import numpy as np
import pytest
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import controller_model
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots.catalog import IIWA14
from guiderail.systems.wrench_sensors import JointTorqueWrench

READY_POSTURE = np.array(IIWA14.home)


@pytest.fixture(scope="module")
def arm():
    return controller_model(BncWorkcell())


class Rig:
    """Estimator in a simulator, with fixed joint positions and external torques."""

    def __init__(self, arm, torque, **options):
        plant, model = arm
        arguments = {"period": 0.01, "time_constant": 0.0} | options
        self.system = JointTorqueWrench(plant, model.target, model.tool_center, **arguments)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.positions = self.system.get_positions_input_port().FixValue(self.context, READY_POSTURE)
        self.torque = self.system.get_external_torque_input_port().FixValue(self.context, torque)

    def wrench_at(self, time):
        """Advance to a time [s] and return the wrench (6,)."""
        self.simulator.AdvanceTo(time)
        return self.system.get_wrench_output_port().Eval(self.context).copy()


def jacobian(arm):
    """Return the Jacobian (6, 7) of the tool center in the axes of the target, rotational rows first."""
    plant, model = arm
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, READY_POSTURE)
    return plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, model.tool_center, np.zeros(3), model.target, model.target
    )


def estimate(arm, wrench, **options):
    """Return the estimate from the joint torques of a wrench (6,), force first."""
    return Rig(arm, jacobian(arm).T @ np.concatenate([wrench[3:], wrench[:3]]), **options).wrench_at(0.005)


def test_wrench_is_estimated_from_its_joint_torques(arm):
    wrench = np.array([5.0, -3.0, 12.0, 0.2, -0.1, 0.3])
    np.testing.assert_allclose(estimate(arm, wrench, damping=0.0), wrench, atol=1e-9)
    np.testing.assert_allclose(estimate(arm, wrench), wrench, rtol=0.05, atol=0.05)


def test_default_damping_reduces_the_estimate(arm):
    wrench, J = np.array([5.0, -3.0, 12.0, 0.2, -0.1, 0.3]), jacobian(arm)
    damped = np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), J @ J.T @ np.concatenate([wrench[3:], wrench[:3]]))
    np.testing.assert_allclose(estimate(arm, wrench), [*damped[3:], *damped[:3]], rtol=1e-9)


def test_estimate_is_not_filtered_when_the_time_constant_is_zero(arm):
    rig = Rig(arm, np.linspace(-1.0, 1.0, 7))
    first = rig.wrench_at(0.005)
    rig.torque.GetMutableData().set_value(np.linspace(-2.0, 2.0, 7))
    np.testing.assert_allclose(rig.wrench_at(0.015), 2.0 * first, atol=1e-12)


def test_filter_is_a_first_order_low_pass_from_the_first_sample(arm):
    rig = Rig(arm, np.linspace(-1.0, 1.0, 7), time_constant=0.1, damping=0.0)
    first = rig.wrench_at(0.005)
    assert np.linalg.norm(first) > 0.1
    rig.torque.GetMutableData().set_value(np.linspace(-2.0, 2.0, 7))
    # Five samples, at 10, 20, 30, 40 and 50 ms.
    np.testing.assert_allclose(rig.wrench_at(0.055), first * (2.0 - np.exp(-0.5)), atol=1e-9)
    rig.context.SetTime(0.0)
    rig.simulator.Initialize()
    np.testing.assert_array_equal(rig.system.get_wrench_output_port().Eval(rig.context), np.zeros(6))
    # The first sample after the initialization restarts the filter.
    np.testing.assert_allclose(rig.wrench_at(0.005), 2.0 * first, atol=1e-9)


@pytest.mark.parametrize(
    "arguments",
    [{"period": 0.0}, {"time_constant": -1.0}, {"time_constant": np.inf}, {"damping": -1.0}, {"damping": np.inf}],
)
def test_constructor_refuses_arguments_out_of_range(arm, arguments):
    with pytest.raises(InputError):
        estimate(arm, np.zeros(6), **arguments)


@pytest.mark.parametrize("port", ["positions", "external_torque"])
def test_sample_is_skipped_when_it_is_not_finite(arm, port):
    rig = Rig(arm, np.linspace(-1.0, 1.0, 7), time_constant=0.1)
    before = rig.wrench_at(0.025)
    value = rig.positions if port == "positions" else rig.torque
    value.GetMutableData().set_value(np.full(7, np.nan))
    np.testing.assert_array_equal(rig.wrench_at(0.035), before)
    rig.positions.GetMutableData().set_value(READY_POSTURE)
    rig.torque.GetMutableData().set_value(np.linspace(-2.0, 2.0, 7))
    after = rig.wrench_at(1.0)
    assert np.isfinite(after).all()
    assert np.linalg.norm(after - before) > 0.1


@pytest.mark.parametrize("torque", [1e5, 1e150, 1e308])
def test_single_false_sample_decays_in_the_filter(arm, torque):
    rig = Rig(arm, np.zeros(7), period=0.005, time_constant=0.02)
    rig.wrench_at(0.012)
    rig.torque.GetMutableData().set_value(np.full(7, -torque))
    assert np.linalg.norm(rig.wrench_at(0.017)) > 1e3
    rig.torque.GetMutableData().set_value(np.zeros(7))
    assert np.linalg.norm(rig.wrench_at(0.217)) < 10.0
