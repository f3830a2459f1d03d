"""What a dataset is like, measured (`qs3 inspect`), and the gap between two (`qs3 compare`)."""
