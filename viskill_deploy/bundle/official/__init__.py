"""Checkpoints of the official ViSkill code: read without running anything, written as bundles."""
