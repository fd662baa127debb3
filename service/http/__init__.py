"""The HTTP interface: thin routers over `service.core`. Nothing outside this package uses FastAPI."""
