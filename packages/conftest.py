from bead_runs import _bead_run, bead_config, bead_run  # noqa: F401
from quick_pictures import simplify_pictures  # noqa: F401
