"""Judging results by the field's own rules; every figure carries the protocol that made it."""
