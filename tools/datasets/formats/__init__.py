"""Recordings of others: CSV as people have it, ROS 2 bags and MCAP, LeRobot datasets."""
