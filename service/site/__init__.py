"""A site: many cells side by side, read from their APIs, and their histories in one folder; each cell stays whole without it."""
