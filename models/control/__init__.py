"""Control laws without Drake systems: impedance, wrenches, limits and filters of commands."""
