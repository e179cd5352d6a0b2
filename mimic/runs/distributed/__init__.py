"""Several processes and GPUs of one training."""
