"""`python -m mimic.collect`: the results of finished runs in one table."""
