"""Where photos were taken: poses of new photos in the frame of a finished map."""
