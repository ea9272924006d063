"""Geometry of parts: mesh files, checks, convex decomposition, symmetry and a demonstrator."""
