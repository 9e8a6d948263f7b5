"""Observatory records: their quality, quiet days and statistics in time."""
