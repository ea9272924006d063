"""Formats of recordings: CSV files, ROS bags and MCAP, LeRobot datasets."""
