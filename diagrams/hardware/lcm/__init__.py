"""Drivers on LCM, Drake's message bus, and the simulated driver."""
