"""Sweeps over random cells: draws panels, operates every control through the HTTP API, and judges by the simulator's truth."""
