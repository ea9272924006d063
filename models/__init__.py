"""Models without Drake systems: robots, objects, demonstrations, movement primitives and templates."""
