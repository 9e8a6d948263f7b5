"""Transforms of gridded magnetic anomalies."""
