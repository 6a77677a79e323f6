"""The gate: nothing reaches a driver that it has not passed."""
