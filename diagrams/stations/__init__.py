"""Stations: diagrams of a robot, its controller and the objects of a task, all with the same ports."""
