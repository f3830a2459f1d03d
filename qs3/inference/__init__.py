"""A trained classifier at work: model file, predictor, the predict command, export."""
