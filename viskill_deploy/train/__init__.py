"""Learning. The only part that knows torch."""
