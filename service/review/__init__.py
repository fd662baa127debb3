"""Review: readings that are not sure wait for a person, whose answer corrects the history."""
