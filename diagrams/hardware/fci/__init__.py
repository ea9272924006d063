"""Drivers of robots that speak the Franka Control Interface."""
