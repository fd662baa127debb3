"""A typed client of panelwright's HTTP API. `Client` has one method for each call; `models` holds requests and results."""

from panelwright_client.calls import Client
from panelwright_client.transport import FINAL, Refused

__all__ = ["FINAL", "Client", "Refused"]
