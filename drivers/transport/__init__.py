"""Wires: links, framing, request and answer, owner threads, mailboxes. Devices are built from these."""
