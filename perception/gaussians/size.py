"""Size of the model and length of the training, by the size of the place: both are proportional to its photos."""

from __future__ import annotations

from perception.config import MapConfig

USUAL_PHOTOS = 43
"""Training photos of a table or a small room, for which ITERATIONS and BUDGET were chosen; fewer need as many."""
ITERATIONS, BUDGET = 2000, 100_000


def sized(config: MapConfig, photos: int, most: int | None = None) -> MapConfig:
    """`config` with the iterations and the budget of Gaussians that are not given (0), for a number of training photos.

    Times `train.effort`, both are ITERATIONS and BUDGET for USUAL_PHOTOS or fewer, and proportional to the photos
    beyond. Growth ends before the budget, and training before its end, where more does not pay (`train.exchange_db`).
    most: largest budget that is chosen.
    """
    share = config.train.effort * max(1.0, photos / USUAL_PHOTOS)
    iterations = config.train.iterations or max(1, round(ITERATIONS * share))
    budget = config.train.budget or max(100, round(BUDGET * share))
    if most is not None and not config.train.budget:
        budget = max(100, min(budget, most))
    train = config.train.model_copy(update={"iterations": iterations, "budget": budget})
    return config.model_copy(update={"train": train})
