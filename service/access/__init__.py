"""Keys of the API: who may use it, in which role, and in whose name something is recorded."""
