"""Tasks, the lease on motion, the gate between tasks and the cell, and the journal of what was done."""
