"""The contracts: one JSON Schema per data kind, and the errors that name a breach."""
