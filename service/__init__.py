"""The service that runs a cell: processes, tasks, HTTP, stop, journal, reports and command line."""
