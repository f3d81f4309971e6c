"""Judging results by the field's own rules; every figure carries the protocol that made it."""

from perception.evaluate.run import run_images, run_instances

__all__ = ["run_images", "run_instances"]
