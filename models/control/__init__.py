"""Control laws without Drake systems: impedance, wrenches, joint faults."""
