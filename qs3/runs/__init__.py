"""What a run leaves on disk: its folder, checkpoints, predictions and pseudo-labels."""
