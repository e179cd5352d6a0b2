"""Motions in the formats of other projects: LeRobot datasets and rosbag2."""
