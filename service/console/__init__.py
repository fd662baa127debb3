"""The console: pages for operators, in a process of its own. It is a client of the HTTP API and holds no truth."""
