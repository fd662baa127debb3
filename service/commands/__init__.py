"""One file a group of commands; `service.cli` puts them together."""
