"""The learners with Stable-Baselines3's own gradient step, by name: what this package's are compared with.

Import this module where they are to be found: `guiderail train TASK --import guiderail.tools.benchmarks.plain_learners
--algorithm plain_tqc --out RUN`.
"""

from sb3_contrib import TQC
from stable_baselines3 import SAC

from guiderail.tools.learning.learner import register_learner
from guiderail.tools.learning.off_policy import OffPolicyLearner


@register_learner("plain_sac")
class PlainSac(OffPolicyLearner):
    """With Stable-Baselines3's own gradient step."""

    algorithm = SAC


@register_learner("plain_tqc")
class PlainTqc(OffPolicyLearner):
    """With sb3-contrib's own gradient step."""

    algorithm = TQC
