"""Drivers of robots: interface, protocols, simulated counterparts and clocks."""
