"""A finished map as text and as a page."""
