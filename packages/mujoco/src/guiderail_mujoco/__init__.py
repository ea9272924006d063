"""MuJoCo as a second physics engine: `station="mujoco"`."""
