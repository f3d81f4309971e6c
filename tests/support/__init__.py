"""What tests of several folders share: scenes, small maps, model files, reference implementations, child processes."""
