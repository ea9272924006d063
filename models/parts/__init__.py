"""Insertion tasks from mesh files: reading, checks, convex decomposition, symmetry and a demonstrator."""
