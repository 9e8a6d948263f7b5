"""Shared mathematics of the reader and the stages."""
