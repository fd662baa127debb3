"""Mission files: found, checked against a panel, and run step by step by anything that has hands and eyes."""
