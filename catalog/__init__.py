"""What exists: public sources, products, and releases with the reader an estimator imports."""
