"""The front of the cell: processes, tasks, HTTP, stop, journal, reports, command line."""
