"""What devices of one kind share, whatever wire leads to them."""
