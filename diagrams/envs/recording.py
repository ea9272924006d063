"""Recording of a station that follows a given motion, for demonstrations, benchmarks and tests of physics.

No environment uses it: contact probes, guiderail-parts and research do. The record of an episode is `trace.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.primitives import TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.stations.station import CONTROL_PERIOD, Station
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.systems.recorder import Recorder, Recording

SIGNALS = {"desired_pose": POSE_SIZE, "pose": POSE_SIZE, "wrench": 6, "contact_force": 1, "saturation": 1}


class DrivenStation:
    """Station and recorder; the desired pose (6,) is the output of a system, sampled once per `CONTROL_PERIOD`.

    Attributes:
        station: Driven station.
        recorder: Recorder of `SIGNALS`, and of `impedance_force` if the station has an impedance.
        diagram: Diagram of station, source and recorder.
        simulator: Simulator of this diagram.
    """

    def __init__(self, station: Station, source: System, num_samples: int):
        """Construct the diagram and its simulator.

        Args:
            station: Station; it becomes part of the diagram.
            source: System with the desired pose as first output, such as a trajectory, an input device or a policy.
            num_samples: Largest number of control periods to record, at least 1.

        Raises:
            InputError: If `num_samples` is below 1.
        """
        builder = DiagramBuilder()
        self.station = builder.AddNamedSystem("station", station)
        builder.AddNamedSystem("source", source)
        self._hold = ZeroOrderHold(CONTROL_PERIOD, POSE_SIZE)
        desired_pose = add_system(builder, "hold", self._hold, source.get_output_port(0)).get_output_port()
        builder.Connect(desired_pose, station.get_desired_pose_input_port())
        forces = station.impedance_force()
        recorder = Recorder(SIGNALS | dict.fromkeys(forces, 1), num_samples, CONTROL_PERIOD)
        measured = {name: station.GetOutputPort(name) for name in SIGNALS if name != "desired_pose"} | forces
        self.recorder = add_system(builder, "recorder", recorder, desired_pose=desired_pose, **measured)
        self.diagram: Diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self._num_samples = num_samples

    @property
    def context(self) -> Context:
        """Root context."""
        return self.simulator.get_mutable_context()

    @property
    def plant_context(self) -> Context:
        """Context of the plant."""
        return self.station.plant.GetMyMutableContextFromRoot(self.context)

    def start(self, pose: np.ndarray) -> None:
        """Set the tool center at rest at `pose`, (6,), and initialize the simulator; call this before `run`."""
        self.station.set_pose(self.context, pose)
        # The first plant step reads the hold before its first sample.
        self._hold.SetVectorState(self._hold.GetMyMutableContextFromRoot(self.context), pose)
        self.simulator.Initialize()

    def run(self, num_steps: int | None = None) -> Recording:
        """Advance `num_steps` control periods, by default until the recorder is full, and return the recording."""
        recorder_context = self.recorder.GetMyContextFromRoot(self.context)
        num_recorded = int(self.recorder.get_num_recorded_output_port().Eval(recorder_context)[0])
        num_samples = self._num_samples if num_steps is None else num_recorded + num_steps
        self.simulator.AdvanceTo(num_samples * CONTROL_PERIOD)
        self.simulator.AdvancePendingEvents()
        return self.recorder.recording(recorder_context)


def linear_motion(times: np.ndarray, poses: np.ndarray) -> TrajectorySource:
    """Return a source of straight lines between `poses` (N, 6) at `times` (N,) [s]; the last pose is held."""
    return TrajectorySource(PiecewisePolynomial.FirstOrderHold(np.asarray(times), np.asarray(poses).T))


def drive_along(
    station: Station, times: np.ndarray, poses: np.ndarray, prepare: Callable[[Any, Any], None] | None = None
) -> tuple[DrivenStation, Recording]:
    """Drive a station along poses (N, 6) at times (N,) from 0 [s]; return the driven station and the recording.

    `prepare` is called with the plant and its context before the start.
    """
    times, poses = np.asarray(times, dtype=float), np.asarray(poses, dtype=float)
    driven = DrivenStation(station, linear_motion(times, poses), num_samples=round(times[-1] / CONTROL_PERIOD))
    if prepare is not None:
        prepare(station.plant, driven.plant_context)
    driven.start(poses[0])
    return driven, driven.run()
