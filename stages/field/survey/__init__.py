"""Point surveys of small areas as grids."""
