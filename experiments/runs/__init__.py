"""Runs read from disk, and which of them may be compared."""
