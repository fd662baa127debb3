"""From clicks and answers to what the system knows: a new kind, or the file of a whole panel."""
