"""Judging results by the field's own rules; every figure carries the protocol that made it."""

from perception.evaluate.images import run_images
from perception.evaluate.labelled_clouds import run_instances

__all__ = ["run_images", "run_instances"]
