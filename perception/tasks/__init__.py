"""Where tasks run, and the folders that hold them."""
