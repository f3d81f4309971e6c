"""A finished map in words and as a page."""
