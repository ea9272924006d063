from bead_runs import _bead_run, bead_config, bead_run, simplify_pictures  # noqa: F401
