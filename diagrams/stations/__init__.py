"""Stations: a robot, its controller and the objects of a task, with the same ports."""
