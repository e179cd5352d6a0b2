"""Trained networks that come with the package: a policy and a pose mapper of each environment."""
