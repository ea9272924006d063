"""Tasks made from the meshes of two parts."""
