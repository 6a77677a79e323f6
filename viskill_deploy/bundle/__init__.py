"""The bundle format, and running the skills of one."""
