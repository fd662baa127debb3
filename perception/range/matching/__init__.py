"""Component models, and the search for their poses in an analysed scene."""
