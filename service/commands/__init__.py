"""The commands, one file per group; `service.cli` puts them together."""
