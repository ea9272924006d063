"""Vessels and balls of the pouring task."""
