"""The history: every reading that missions and inspections have taken, kept over restarts."""
