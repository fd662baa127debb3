"""What brings a machine and single devices of a cell into service: checks, conformance, reading, recording, new drivers."""
