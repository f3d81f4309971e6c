"""Composes the stages of mapping, resumes them, and writes the run record."""
