"""Records of geomagnetic observatories, and indices of activity, from their exchange formats."""
