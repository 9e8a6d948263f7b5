"""Cutting and writing what a release holds."""
