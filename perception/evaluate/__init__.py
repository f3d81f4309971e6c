"""Evaluation with the standard benchmark protocols. Every result names the protocol that produced it."""
