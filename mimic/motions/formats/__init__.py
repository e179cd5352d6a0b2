"""Motions in the formats of other projects, such as LeRobot datasets and rosbag2."""
