"""Robots behind one protocol: the loopback simulator here, hardware beside it."""
