"""Where photos were taken: poses of new photos in the frame of a finished map."""

from perception.localise.localiser import Localised, Localiser, NewPhoto, NotHere

__all__ = ["Localised", "Localiser", "NewPhoto", "NotHere"]
