"""The HTTP front: thin routers over `service.core`. The only place that knows FastAPI."""
