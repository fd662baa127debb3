"""Circuit breakers on a DIN rail, as a kind of object that panelwright reads, throws and simulates."""
