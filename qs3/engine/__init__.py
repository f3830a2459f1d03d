"""The LightningModule, and its checkpoints, loggers and CUDA graphs."""
