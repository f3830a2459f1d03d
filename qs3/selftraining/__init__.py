"""Self-training: which pseudo-labels to trust, and the rounds that learn from them."""
