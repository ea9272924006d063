"""Templates and start poses that a template guide refuses."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform
from guiderail.models.templates import load_template, parse_template
from guiderail.tools.guided import guide

CONTRADICTORY = """
name: slab
inputs: 1
frames: [slab]
max_speed_m_per_s: 0.5
max_speed_rad_per_s: 1.0
states:
  above:
    input_mapping: [{kind: translation, inputs: [0], axes: [[0, 0, 1]], speed_m_per_s: 0.5}]
    active_constraints:
      - {kind: fixed_orientation, frame: slab, rpy_deg: [0, 0, 90]}
      - {kind: fixed_orientation, frame: slab}
    transition_distance: {kind: height, frame: slab}
    starts_at_m: 1.0
    ends_at_m: 0.0
"""


def test_template_guide_raises_far_from_the_constraints():
    frames = {"mug_tip": RigidTransform([0.0, 0.0, 300.0])}  # height of 300 mm, given in meters by mistake
    template_guide = guide.TemplateGuide(load_template("pouring"), lambda env, observation: frames, 0.02)
    with pytest.raises(InputError, match="outside of the active constraints of the template pouring"):
        template_guide.reset(None, None, np.zeros(6))


def test_template_guide_raises_when_constraints_contradict():
    with pytest.raises(InputError, match="slab, state above: active constraint 1"):
        guide.TemplateGuide(parse_template(CONTRADICTORY), lambda env, observation: {}, 0.02)
