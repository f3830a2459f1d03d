"""A toy problem, for tests and demonstrations."""
