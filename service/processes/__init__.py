"""The processes of a running cell: `cell` and `stop`, who starts and watches them, and what joins them.

`supervisor` starts, watches and restarts; `child` is one process that cannot outlive its parent; `latch` is the stop's byte of
shared memory; `connection` is the service's hold on the cell, `seats` where its devices sit, `motion` its control thread.
"""
