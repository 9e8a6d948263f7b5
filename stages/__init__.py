"""The science: pure functions from datasets to datasets, each declared as a Stage."""
