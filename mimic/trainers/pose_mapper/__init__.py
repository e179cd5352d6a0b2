"""The neural pose mapper."""
