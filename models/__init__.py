"""What is known, free of Drake systems: robots, objects, demonstrations, movement primitives and templates."""
