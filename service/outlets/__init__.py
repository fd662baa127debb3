"""Outlets: what a cell tells other programs of the plant, from the gateway's process, which is a client of the HTTP API."""
