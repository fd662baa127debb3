"""What the hand can do to a panel: one file a skill, typed outcomes, nothing done without a look."""
