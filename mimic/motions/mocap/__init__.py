"""Motion capture: points of a body over time, its arms, and their link states."""
