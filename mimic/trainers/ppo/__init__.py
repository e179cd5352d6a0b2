"""PPO on an imitation environment."""
