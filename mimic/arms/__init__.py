"""Arms: what is known of one, where it is read from, and the model that simulates and draws it."""
