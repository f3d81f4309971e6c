"""Reading and writing: photos, camera files, COLMAP workspaces, transforms.json, structure from motion."""
