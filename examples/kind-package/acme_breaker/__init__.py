"""Circuit breakers on a DIN rail: a kind of object that panelwright reads, operates and simulates."""
