"""Waypoints, and their jerk-limited smoothing."""
