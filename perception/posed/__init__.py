"""Photos whose poses are given: their points, and poses refined where matches show that they are wrong."""
