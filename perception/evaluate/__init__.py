"""Evaluation with the standard benchmark protocols. Every result names the protocol that produced it."""

from perception.evaluate.images import run_images
from perception.evaluate.labelled_clouds import run_instances

__all__ = ["run_images", "run_instances"]
