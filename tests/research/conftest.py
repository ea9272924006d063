"""Fixtures of the tests of research."""

from bead_runs import _bead_run, bead_config, bead_run  # noqa: F401
