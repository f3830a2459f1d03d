"""LightningDataModules: clouds of one or two domains, sampled, batched and augmented."""
