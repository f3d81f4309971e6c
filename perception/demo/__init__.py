"""Photos of a made-up tabletop with exact truth, for `perception demo` and the tests."""
