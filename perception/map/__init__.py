"""The map in memory and on disk."""
