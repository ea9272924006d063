import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.systems.recorder import Recorder

PERIOD = 0.25  # exact in binary, so that events coincide


@pytest.fixture
def ramp():
    """Return a simulator and a recorder of a held command (0, 1, 2, …) and of the time in periods."""
    builder = DiagramBuilder()
    line = PiecewisePolynomial.FirstOrderHold([0.0, 100.0], np.array([[0.0, 400.0]]))
    source = builder.AddSystem(TrajectorySource(line))
    hold = builder.AddSystem(ZeroOrderHold(PERIOD, 1))
    recorder = builder.AddSystem(Recorder({"command": 1, "measured": 1}, num_samples=4, period=PERIOD))
    builder.Connect(source.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), recorder.get_signal_input_port("command"))
    builder.Connect(source.get_output_port(), recorder.get_signal_input_port("measured"))
    return Simulator(builder.Build()), recorder


def read(simulator, recorder):
    """Return the recording of the recorder in the simulator's diagram."""
    return recorder.recording(recorder.GetMyContextFromRoot(simulator.get_context()))


def test_sample_has_a_command_and_the_measurement_after_it(ramp):
    simulator, recorder = ramp
    simulator.AdvanceTo(3.5 * PERIOD)
    recording = read(simulator, recorder)
    np.testing.assert_array_equal(recording["command"][:, 0], [0, 1, 2])
    np.testing.assert_allclose(recording["measured"][:, 0], [1, 2, 3])
    np.testing.assert_allclose(recording.times, [0, PERIOD, 2 * PERIOD])


def test_recording_refuses_the_root_context(ramp):
    simulator, recorder = ramp
    with pytest.raises(RuntimeError, match="Use GetMyContextFromRoot"):
        recorder.recording(simulator.get_context())


@pytest.mark.parametrize("period", [0.02, 0.1, 1 / 3, 0.007])
def test_each_command_is_recorded_exactly_once(period):
    builder = DiagramBuilder()
    line = PiecewisePolynomial.FirstOrderHold([0.0, 1000 * period], np.array([[0.0, 1000.0]]))
    source = builder.AddSystem(TrajectorySource(line))
    hold = builder.AddSystem(ZeroOrderHold(period, 1))
    recorder = builder.AddSystem(Recorder({"command": 1}, num_samples=400, period=period))
    builder.Connect(source.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), recorder.get_signal_input_port("command"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(400.5 * period)
    np.testing.assert_allclose(read(simulator, recorder)["command"][:, 0], np.arange(400), atol=1e-9)


def test_recording_stops_when_it_is_full(ramp):
    simulator, recorder = ramp
    simulator.AdvanceTo(20 * PERIOD)
    assert len(read(simulator, recorder).times) == 4


def test_reset_clears_the_samples(ramp):
    simulator, recorder = ramp
    pristine = simulator.get_context().Clone()
    simulator.AdvanceTo(3.5 * PERIOD)
    simulator.get_mutable_context().SetTimeStateAndParametersFrom(pristine)
    assert len(read(simulator, recorder).times) == 0


def test_initialization_restarts_samples_and_times(ramp):
    simulator, recorder = ramp
    simulator.AdvanceTo(2.5 * PERIOD)
    simulator.get_mutable_context().SetTime(8 * PERIOD)
    simulator.Initialize()
    assert len(read(simulator, recorder).times) == 0
    simulator.AdvanceTo(10.5 * PERIOD)
    recording = read(simulator, recorder)
    np.testing.assert_array_equal(recording.times, [8 * PERIOD, 9 * PERIOD])
    np.testing.assert_allclose(recording["measured"][:, 0], [9, 10])


def test_recording_is_a_copy(ramp):
    simulator, recorder = ramp
    simulator.AdvanceTo(2.5 * PERIOD)
    first = read(simulator, recorder)
    first["command"][:] = -1.0
    assert (read(simulator, recorder)["command"] >= 0.0).all()
