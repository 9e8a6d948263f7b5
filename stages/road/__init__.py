"""Road maps: from a drive to the field at equal distances, and from many drives to one map."""
