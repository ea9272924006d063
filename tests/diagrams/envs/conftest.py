from coarse_connector import coarse_connector  # noqa: F401
