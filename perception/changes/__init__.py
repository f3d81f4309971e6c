"""Signs of change: what photos say beside a map of what stands, has gone, moved or is new."""
