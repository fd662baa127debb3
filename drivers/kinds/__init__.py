"""Code shared by devices of one kind, whatever link they use."""
