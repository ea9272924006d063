"""Formats of recordings: CSV files, ROS 2 bags and MCAP, LeRobot datasets."""
