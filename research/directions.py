"""The connector with directions of force and torque as observation, without magnitudes.

Contact policies may transfer better between engines if they observe where a contact is, not how hard it
is (arXiv 2602.14174). `ConnectorDirections` replaces the wrench in the observation by the unit vectors of force and
torque; everything else, also the contact points, which do not depend on the magnitude either, is as in `BncConnector`.
Study: `research/studies/connector_hard_directions.yaml`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort

from guiderail.diagrams.envs.observation import Observed
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.bnc_connector import BncConnector
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.wiring import add_system
from guiderail.systems.support import declarations as declare

MIN_FORCE, MIN_TORQUE = 0.5, 0.005  # smallest force [N] and torque [Nm] that have a direction


class WrenchDirections(LeafSystem):
    """Unit vectors of force and torque, each 0 below its threshold.

    ``wrench`` is (6,), force and torque [N, Nm]; ``wrench_directions`` is (6,).
    """

    def __init__(self) -> None:
        super().__init__()
        port = self.DeclareVectorInputPort("wrench", 6)
        declare.output(self, "wrench_directions", 6, lambda context: directions(port.Eval(context)), [port])


def directions(wrench: np.ndarray) -> np.ndarray:
    """Return the unit vectors of force and torque of a wrench (6,), each 0 below its threshold."""
    parts = zip(np.split(np.asarray(wrench, float), 2), (MIN_FORCE, MIN_TORQUE), strict=True)
    return np.concatenate(
        [part / length if (length := float(np.linalg.norm(part))) >= least else 0.0 * part for part, least in parts]
    )


@register_task("ConnectorDirections")
class ConnectorDirections(BncConnector):
    """BncConnector whose policy observes the directions of force and torque instead of the wrench."""

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the signals of BncConnector and the directions."""
        system = WrenchDirections()
        add_system(builder, "wrench_directions", system, wrench=station.get_wrench_output_port())
        return {**super().signals(builder, station), "wrench_directions": system.GetOutputPort("wrench_directions")}

    def observe(self) -> Observed:
        """Return the observation of BncConnector, with directions for the wrench."""
        observed = super().observe()
        terms = (
            replace(term, signal="wrench_directions", center=0.0, scale=1.0) if term.signal == "wrench" else term
            for term in observed.terms
        )
        return replace(observed, terms=tuple(terms))
