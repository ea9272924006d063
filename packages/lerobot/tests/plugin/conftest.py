"""Excludes the tests of the plug-in where LeRobot is not installed; `make lerobot` runs them."""

from importlib.util import find_spec

collect_ignore_glob = [] if find_spec("lerobot") else ["test_*.py"]
