"""Words for instances: encoders behind one protocol, descriptions, and the ranking of a prompt's answers."""

from __future__ import annotations

from perception.language.base import Encoder, make_encoder

__all__ = ["Encoder", "make_encoder"]
