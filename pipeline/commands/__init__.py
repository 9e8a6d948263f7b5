"""The commands, one module each; importing them needs nothing beyond the standard library."""
