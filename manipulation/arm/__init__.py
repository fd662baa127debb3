"""The arm as geometry: its chain of joints, forwards and backwards."""
