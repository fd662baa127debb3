"""A recorded cell in place of the real one, and a comparison of what comes out."""
