"""A simulated week of rounds: a plant with drifting values, run in minutes, and the checks of what it has left."""
