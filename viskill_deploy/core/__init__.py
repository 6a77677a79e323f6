"""Plain values, every error, the only reader of time, the finder of data files."""
