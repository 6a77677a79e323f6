"""The loop: read, decide, gate, send, record."""
