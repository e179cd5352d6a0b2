"""Trainers: PPO and the pose mapper."""
