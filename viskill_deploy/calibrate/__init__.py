"""Calibration: what a real cell is, measured against what its files say."""
