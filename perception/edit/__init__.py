"""Corrections of a finished map."""
