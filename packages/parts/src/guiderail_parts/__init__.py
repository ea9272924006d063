"""Insertion tasks from the mesh files of two parts."""
