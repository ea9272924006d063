"""Plane with a narrow passage."""
