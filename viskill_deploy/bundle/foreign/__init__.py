"""Policies that were exported elsewhere, wrapped so that they see and act as the runtime does."""
