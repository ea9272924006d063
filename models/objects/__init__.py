"""Geometry, assets and demonstrations of the objects, one folder each."""
