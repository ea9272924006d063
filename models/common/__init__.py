"""Errors, files, YAML, units, poses and registries that all parts use."""
