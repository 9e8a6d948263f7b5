"""The machine: runs stages, keeps receipts, builds products, serves the command line."""
