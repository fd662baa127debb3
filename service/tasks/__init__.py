"""Who may do what, and what was done: tasks, the lease on motion, the gate between them and the cell, the journal."""
