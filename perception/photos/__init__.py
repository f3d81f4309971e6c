"""Photos, videos, lenses, depth images and masks of ignored pixels: pixels and cameras."""
