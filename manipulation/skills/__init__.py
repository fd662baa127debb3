"""What the hand can do to a panel: one file per kind of control, with typed outcomes; nothing is done without a second look."""
