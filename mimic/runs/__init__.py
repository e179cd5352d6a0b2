"""Run directories: files, checkpoints, loggers, signals."""
