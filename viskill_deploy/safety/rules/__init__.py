"""One rule a file. Every rule in this folder is always on."""
