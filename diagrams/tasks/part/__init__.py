"""Insertion tasks made from the meshes of two parts."""
