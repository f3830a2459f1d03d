"""The LightningModule, its schedules and loggers, and the trainer that runs it."""
