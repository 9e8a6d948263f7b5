"""Manifests, integrity and the reader of published releases."""
